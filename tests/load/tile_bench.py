#!/usr/bin/env python3
"""Cold and warm tiles, a stampede and resident memory of the daemon. Needs wrk.

    tests/load/tile_bench.py build/release/lodestone [--seconds 4] [--rounds 3] [--requests 100000]

Prints medians and ratios of rows measured in turn in one run.
"""
import argparse
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
LUA = """
math.randomseed(%d)
request = function()
  return wrk.format("GET", string.format("/tiles/hills/lsa/5/%%d/%%d.%s", math.random(0, 24), math.random(0, 20)))
end
"""


class Daemon:
    def __init__(self, program, data, *flags):
        self.process = subprocess.Popen([program, 'serve', '--data-dir', data, '--listen', '127.0.0.1:0', '--admin-listen', 'off', *flags],
                                        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        self.url = self.process.stdout.readline().split()[-1]

    def get(self, path):
        with urllib.request.urlopen(self.url.rstrip('/') + path, timeout=60) as reply:
            return reply.read()

    def resident_mib(self):
        with open(f'/proc/{self.process.pid}/statm', encoding='ascii') as statm:
            return int(statm.read().split()[1]) * 4096 / 2**20

    def metric(self, name):
        return float(re.search(rf'^lodestone_{name} (\S+)$', self.get('/metrics').decode(), re.M)[1])

    def stop(self):
        self.process.terminate()
        self.process.wait()


def wrk(daemon, extension, seconds, folder, seed):
    script = os.path.join(folder, 'random.lua')
    with open(script, 'w', encoding='ascii') as out:
        out.write(LUA % (seed, extension))
    text = subprocess.run(['wrk', '-t1', '-c16', f'-d{seconds}', '-s', script, daemon.url], stdout=subprocess.PIPE, text=True, check=True).stdout
    if 'Non-2xx' in text:
        raise RuntimeError(text)
    return float(re.search(r'Requests/sec:\s+([\d.]+)', text)[1])


def cold_and_warm(program, data, folder, seconds, rounds):
    for extension in ('f32', 'exr'):
        cold, warm = [], []
        for round_number in range(rounds):
            daemon = Daemon(program, data, '--memory-cache-mib', '0', '--disk-cache-mib', '0')
            cold.append(wrk(daemon, extension, seconds, folder, round_number))
            daemon.stop()
            daemon = Daemon(program, data, '--memory-cache-mib', '1024', '--disk-cache-mib', '0')
            for x in range(25):
                for y in range(21):
                    daemon.get(f'/tiles/hills/lsa/5/{x}/{y}.{extension}')
            warm.append(wrk(daemon, extension, seconds, folder, round_number))
            daemon.stop()
        ratio = statistics.median(c / w for c, w in zip(cold, warm))
        print(f'{extension}: cold {statistics.median(cold):.0f}/s, warm {statistics.median(warm):.0f}/s, ratio {ratio:.3f} (goal 0.25)')


def stampede(program, data):
    daemon = Daemon(program, data, '--disk-cache-mib', '0')
    daemon.get('/tiles/hills/lsa/5/0/0.f32')
    singles = []
    for n in range(1, 12):
        began = time.monotonic()
        daemon.get(f'/tiles/hills/lsa/5/{n}/1.f32')
        singles.append(time.monotonic() - began)
    def burst(path):
        """99th percentile of 200 clients that ask at once, seconds."""
        times = []
        gate = threading.Barrier(200)

        def client():
            gate.wait()
            began = time.monotonic()
            daemon.get(path)
            times.append(time.monotonic() - began)

        threads = [threading.Thread(target=client) for _ in range(200)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return sorted(times)[197]

    cold, warm, computed = [], [], []
    for round_number in range(7):
        path = f'/tiles/hills/lsa/9/{77 + round_number}/88.f32'
        before = daemon.metric('tiles_generated_total')
        cold.append(burst(path))
        computed.append(daemon.metric('tiles_generated_total') - before)
        warm.append(burst(path))  # the same clients and the same transfer, without the computation
    single = statistics.median(singles)
    cold_ms, warm_ms = statistics.median(cold) * 1e3, statistics.median(warm) * 1e3
    print(f'stampede: 200 clients, computations {max(computed):.0f}, p99 {cold_ms:.1f} ms; single cold request {single * 1e3:.1f} ms, the same '
          f'clients on the warm tile {warm_ms:.1f} ms: goal <= {1.2 * single * 1e3 + warm_ms:.1f} ms')
    daemon.stop()


def memory(program, data, folder, requests):
    daemon = Daemon(program, data, '--memory-cache-mib', '128', '--disk-cache-mib', '256')
    samples = []
    done = 0
    seed = 1000
    while done < requests:
        done += int(wrk(daemon, 'f32', 2, folder, seed) * 2)
        seed += 1
        samples.append((done, daemon.resident_mib()))
    half = [rss for count, rss in samples if count > done / 2]
    slope = (half[-1] - half[0]) / half[0] * 100
    limit = 128 + 64 + 64 + 250
    print(f'memory: {done} requests, resident {samples[-1][1]:.0f} MiB (budgets + 250 MiB = {limit}), last half {slope:+.2f} % (goal < 1 %)')
    daemon.stop()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('program')
    parser.add_argument('--seconds', type=int, default=4)
    parser.add_argument('--rounds', type=int, default=3)
    parser.add_argument('--requests', type=int, default=100000)
    arguments = parser.parse_args()
    if shutil.which('wrk') is None:
        sys.exit('wrk is not installed')
    program = os.path.abspath(arguments.program)
    with tempfile.TemporaryDirectory() as folder:
        data = os.path.join(folder, 'data')
        subprocess.run([program, 'ingest', os.path.join(ROOT, 'config/jacksboro.vrt'), '--layer', 'hills', '--data-dir', data], check=True,
                       stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        print(f'load average {os.getloadavg()[0]:.1f}')
        cold_and_warm(program, data, folder, arguments.seconds, arguments.rounds)
        stampede(program, data)
        memory(program, data, folder, arguments.requests)


if __name__ == '__main__':
    main()
