"""kill -9 of the daemon at random moments while it writes its disk cache."""

import itertools
import pathlib
import random
import shutil
import tempfile
import time
import unittest

import rig

KILLS = 50
CACHE_MIB = 24
SAMPLES = 8


class KillDaemonTest(unittest.TestCase):
    def setUp(self):
        self.folder = pathlib.Path(tempfile.mkdtemp(prefix="lodestone-kill-"))
        self.addCleanup(shutil.rmtree, self.folder)
        self.data = self.folder / "data"
        rig.ingest(self.data, rig.SAMPLE_DEM, "hills")
        self.oracle = rig.Oracle(self.data)
        self.addCleanup(self.oracle.close)

    def test_every_start_is_quick_and_every_tile_right(self):
        rng = random.Random(20240607)
        seeds = itertools.count()
        tiles = [(3, x, y) for x in range(6) for y in range(5)]

        def fresh_paths():
            for seed in seeds:
                z, x, y = tiles[seed % len(tiles)]
                yield f"/tiles/hills/lsa/{z}/{x}/{y}.f32?seed={seed}"

        written = []
        from_disk = 0
        # The very first start compiles the kernels; the ones after a kill must not.
        with rig.Daemon(self.data, "--disk-cache-mib", CACHE_MIB, "--memory-cache-mib", 16, device=""):
            pass
        for kill in range(KILLS):
            device = "" if kill % 12 == 0 else "host"
            with rig.Daemon(self.data, "--disk-cache-mib", CACHE_MIB, "--memory-cache-mib", 16, device=device) as daemon:
                self.assertLess(daemon.start_s, 5, f"start {kill} (device {device!r}): {daemon.log()}")
                recent = written[-60:]
                for path in rng.sample(recent, min(SAMPLES, len(recent))):
                    reply = daemon.get(path)
                    self.assertEqual(reply.status, 200, f"after kill {kill}, {path}: {reply.body[:300]}")
                    self.assertEqual(rig.digest(reply.body), self.oracle.digest(path), f"after kill {kill}, {path} from {rig.came_from(reply)}")
                    from_disk += rig.came_from(reply) == "disk"
                load = rig.Load(daemon, fresh_paths())
                time.sleep(rng.uniform(0.02, 0.35))
                self.assertTrue(daemon.is_alive(), daemon.log())
                daemon.process.kill()
                load.stop()
            for path, status, _ in load.replies:
                self.assertEqual(status, 200, path)
            written += [path for path, _, _ in load.replies]
        self.assertGreater(len(written), 10 * KILLS, "the load was too light to mean anything")
        self.assertGreater(from_disk, KILLS, "hardly any sample came from the disk cache")

        self.assertEqual({p.name for p in (self.data / "cache").iterdir()}, {"data.mdb", "lock.mdb", "cache.lock"})
        self.assertLessEqual(rig.tree_bytes(self.data / "cache"), (CACHE_MIB * 5 // 4 + 1) << 20)
        leftovers = [p.name for p in (self.data / "kernels").iterdir() if p.name.startswith("pocl-") or p.name.endswith(".tmp")]
        self.assertLessEqual(len(leftovers), 1, leftovers)
        verified = rig.lodestone("verify", "--data-dir", self.data)
        self.assertEqual(verified.returncode, 0, verified.stdout + verified.stderr)


if __name__ == "__main__":
    unittest.main()
