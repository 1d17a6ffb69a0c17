"""Many clients at once on a daemon that has just started: PoCL must have met every kernel before two workers do."""
import concurrent.futures
import unittest

import lodestone_daemon as ld

STARTS = 6


class FirstLaunches(unittest.TestCase):
    def test_a_burst_right_after_start_is_answered(self):
        workspace = ld.Workspace()
        self.addCleanup(workspace.remove)
        data = workspace.data_dir()
        for start in range(STARTS):
            with ld.Daemon(data, '--memory-cache-mib', '0', '--disk-cache-mib', '0', '--workers', '4') as daemon:
                def ask(n):
                    return daemon.tile(ld.BIG, ld.ALL_RECIPES[n % len(ld.ALL_RECIPES)], 5, n % 25, n % 20, query=f'seed={n}').status

                with concurrent.futures.ThreadPoolExecutor(16) as pool:
                    statuses = list(pool.map(ask, range(96)))
                self.assertEqual(set(statuses), {200}, f'start {start}: {daemon.log()[-1000:]}')


if __name__ == '__main__':
    unittest.main()
