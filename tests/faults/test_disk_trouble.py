"""The tile cache on a full, read-only, blocked or vanished disk: requests are still answered right."""

import os
import pathlib
import resource
import shutil
import subprocess
import tempfile
import time
import unittest

import rig


def mounted(folder, megabytes):
    """True if a tmpfs of that size now lies on the folder; needs root and a permissive container."""
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", folder], stderr=subprocess.DEVNULL)
    return done.returncode == 0


class DiskTroubleTest(unittest.TestCase):
    def setUp(self):
        self.folder = pathlib.Path(tempfile.mkdtemp(prefix="lodestone-disk-"))
        self.addCleanup(shutil.rmtree, self.folder, ignore_errors=True)
        self.data = self.folder / "data"
        rig.ingest(self.data, rig.SAMPLE_DEM, "hills", "--posts-per-tile", 129)
        self.oracle = rig.Oracle(self.data)
        self.addCleanup(self.oracle.close)
        self.cache = self.data / "cache"
        self.cache.mkdir()
        self.next_seed = 0

    def mount(self, megabytes):
        if not mounted(self.cache, megabytes):
            return False
        self.addCleanup(subprocess.run, ["umount", "-l", self.cache], check=False)
        return True

    def fetch(self, daemon, count):
        """Fresh tiles and, after them, the same again."""
        paths = [f"/tiles/hills/lsa/4/{n % 12}/{n // 12 % 10}.f32?seed={self.next_seed + n}" for n in range(count)]
        self.next_seed += count
        for path in paths + paths[::5]:
            reply = daemon.get(path)
            self.assertEqual(reply.status, 200, f"{path}: {reply.body[:300]}\n{daemon.log()[-1000:]}")
            self.assertEqual(rig.digest(reply.body), self.oracle.digest(path), path)

    def await_metric(self, daemon, name, accept, limit_s=15):
        deadline = time.monotonic() + limit_s
        while not accept(value := daemon.metric(name)):
            self.assertLess(time.monotonic(), deadline, f"{name} stays at {value}: {daemon.log()[-1000:]}")
            self.fetch(daemon, 1)
            time.sleep(0.1)

    def assert_degraded(self, daemon):
        ready = daemon.get("/readyz")
        self.assertEqual(ready.status, 200)
        self.assertEqual(ready.json()["status"], "degraded", ready.body)
        self.assertTrue(ready.json()["disk_cache_error"])

    def test_full_disk(self):
        """A small file system, filled by somebody else; it recovers without a restart once there is room."""
        if not self.mount(8):
            self.limited_file_size()
            return
        filler = self.cache / "filler"
        with rig.Daemon(self.data, "--memory-cache-mib", 1) as daemon:
            self.fetch(daemon, 10)
            with open(filler, "wb", buffering=0) as file:
                try:
                    while file.write(bytes(65536)):
                        pass
                except OSError:
                    pass
            self.fetch(daemon, 60)
            self.await_metric(daemon, "cache_write_errors_total", lambda v: v > 0)
            self.assert_degraded(daemon)
            self.fetch(daemon, 20)
            filler.unlink()
            self.await_metric(daemon, "disk_cache_writable", lambda v: v == 1)
            before = daemon.metric("cache_writes_total")
            self.await_metric(daemon, "cache_writes_total", lambda v: v > before)
            self.assertEqual(daemon.get("/readyz").json()["status"], "ready")
            self.assertEqual(daemon.stop(), 0)

    def test_disk_full_from_the_start(self):
        """Room for nothing at all: LMDB cannot even make its files."""
        if not self.mount(1):
            self.limited_file_size()
            return
        with open(self.cache / "filler", "wb", buffering=0) as file:
            try:
                while file.write(bytes(4096)):
                    pass
            except OSError:
                pass
        with rig.Daemon(self.data, "--memory-cache-mib", 1) as daemon:
            self.fetch(daemon, 30)
            self.assert_degraded(daemon)
            self.assertEqual(daemon.stop(), 0)

    def limited_file_size(self):
        """RLIMIT_FSIZE makes writes beyond 1 MiB fail as a full disk does (and sends SIGXFSZ, which must not kill)."""
        old = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, old[1]))
        try:
            daemon = rig.Daemon(self.data, "--memory-cache-mib", 1)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, old)
        with daemon:
            self.fetch(daemon, 60)
            self.await_metric(daemon, "cache_write_errors_total", lambda v: v > 0)
            self.assertTrue(daemon.is_alive())
            self.assert_degraded(daemon)
            self.assertEqual(daemon.stop(), 0)

    def test_file_size_limit(self):
        self.limited_file_size()

    def test_read_only_at_start(self):
        if self.mount(16):
            subprocess.run(["mount", "-o", "remount,ro", self.cache], check=True)
        else:
            self.cache.chmod(0o555)
        with rig.Daemon(self.data, "--memory-cache-mib", 1) as daemon:
            self.fetch(daemon, 30)
            self.assertIn("disk_cache_off", daemon.log())
            self.assert_degraded(daemon)
            self.assertEqual(daemon.stop(), 0)

    def test_read_only_while_running(self):
        if not self.mount(16):
            return self.test_blocked_by_a_file()
        with rig.Daemon(self.data, "--memory-cache-mib", 1) as daemon:
            self.fetch(daemon, 20)
            forced = subprocess.run(["mount", "-o", "remount,ro", self.cache], stderr=subprocess.DEVNULL).returncode == 0
            self.fetch(daemon, 30)
            if forced:
                self.await_metric(daemon, "cache_write_errors_total", lambda v: v > 0)
            self.assertTrue(daemon.is_alive())
            self.assertEqual(daemon.stop(), 0)

    def test_blocked_by_a_file(self):
        self.cache.rmdir()
        self.cache.write_text("not a directory")
        with rig.Daemon(self.data, "--memory-cache-mib", 1) as daemon:
            self.fetch(daemon, 30)
            self.assertIn("disk_cache_off", daemon.log())
            self.assert_degraded(daemon)
        self.assertEqual(self.cache.read_text(), "not a directory")

    def test_vanished_while_running(self):
        with rig.Daemon(self.data, "--memory-cache-mib", 1) as daemon:
            self.fetch(daemon, 30)
            shutil.rmtree(self.cache)
            self.fetch(daemon, 60)
            self.assertTrue(daemon.is_alive())
            self.await_metric(daemon, "disk_cache_writable", lambda v: v == 1)
            self.assertEqual(daemon.stop(), 0)
        with rig.Daemon(self.data, "--memory-cache-mib", 1) as daemon:
            self.fetch(daemon, 10)
            self.assertEqual(daemon.get("/readyz").json()["status"], "ready")

    def test_second_daemon_is_refused(self):
        with rig.Daemon(self.data):
            second = rig.lodestone("serve", "--data-dir", self.data, "--listen", "127.0.0.1:0", "--admin-listen", "off", "--device", "host", timeout=20)
            self.assertEqual(second.returncode, 1)
            self.assertIn("in use by process", second.stderr)
            self.assertEqual(len(second.stderr.strip().splitlines()), 1, second.stderr)

    def test_ingest_on_a_full_disk(self):
        """Refused, and the old layer is still what it was."""
        layers = self.folder / "small" / "layers"
        layers.mkdir(parents=True)
        on_tmpfs = mounted(layers, 1)
        if on_tmpfs:
            self.addCleanup(subprocess.run, ["umount", "-l", layers], check=False)
        large = self.folder / "large.tif"
        subprocess.run(["gdal_translate", "-q", "-r", "bilinear", "-outsize", "1600", "1376", "-ot", "Float32", rig.SAMPLE_DEM, large], check=True)
        data = layers.parent
        rig.ingest(data, rig.SAMPLE_DEM, "hills")
        before = sorted(p.name for p in (layers / "hills").iterdir())
        old = resource.getrlimit(resource.RLIMIT_FSIZE)
        if not on_tmpfs:
            resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, old[1]))
        try:
            result = rig.lodestone("ingest", large, "--layer", "hills", "--data-dir", data)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, old)
        self.assertEqual(result.returncode, 1, result.stderr)
        self.assertEqual(sorted(p.name for p in (layers / "hills").iterdir()), before)
        self.assertEqual(rig.lodestone("verify", "--data-dir", data).returncode, 0)


if __name__ == "__main__":
    unittest.main()
