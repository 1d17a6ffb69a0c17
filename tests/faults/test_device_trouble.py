"""OpenCL trouble: damaged program caches, no device."""

import os
import pathlib
import random
import shutil
import tempfile
import time
import unittest

import rig

PATHS = [f"/tiles/hills/lsa/4/{n}/{n}.f32?seed=5" for n in range(3)] + ["/tiles/hills/gsa/3/1/1.f32"]


class DeviceTroubleTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = pathlib.Path(tempfile.mkdtemp(prefix="lodestone-device-"))
        cls.addClassCleanup(shutil.rmtree, cls.folder)
        cls.data = cls.folder / "data"
        rig.ingest(cls.data, rig.SAMPLE_DEM, "hills", "--posts-per-tile", 65)
        cls.oracle = rig.Oracle(cls.data)
        cls.addClassCleanup(cls.oracle.close)
        # Killed, so that PoCL's own cache of that process stays.
        with rig.Daemon(cls.data, "--disk-cache-mib", 0, device="") as daemon:
            for path in PATHS:
                daemon.get(path)
        cls.kernels = cls.data / "kernels"
        cls.saved = sorted(p for p in cls.kernels.iterdir() if p.is_file())
        cls.pocl_cache, = [p for p in cls.kernels.iterdir() if p.is_dir()]

    def serve_on_device(self, env=None):
        with rig.Daemon(self.data, "--disk-cache-mib", 0, device="", env=env) as daemon:
            for path in PATHS:
                reply = daemon.get(path)
                self.assertEqual(reply.status, 200, f"{path}: {reply.body[:300]} {daemon.log()}")
                self.assertEqual(rig.digest(reply.body), self.oracle.digest(path), path)
            self.assertEqual(daemon.stop(), 0)
            return daemon.start_s

    def damage(self, folder, rng):
        """Every file of a copy of PoCL's cache: cut short, garbled or emptied."""
        target = self.folder / f"pocl-damaged-{rng.random()}"
        shutil.copytree(folder, target)
        files = [p for p in target.rglob("*") if p.is_file()]
        self.assertTrue(files, "PoCL left no cache to damage")
        for number, file in enumerate(files):
            content = file.read_bytes()
            kind = number % 3
            file.write_bytes(content[:len(content) // 2] if kind == 0 else rng.randbytes(len(content)) if kind == 1 else b"")
        return target

    def test_saved_programs_are_damaged(self):
        self.assertTrue(self.saved, "no program was saved")
        rng = random.Random(1)
        contents = {file: file.read_bytes() for file in self.saved}
        damages = (
            lambda data: b"",
            lambda data: data[:len(data) // 2],
            lambda data: rng.randbytes(len(data)),
            lambda data: data[:len(data) // 3] + bytes([data[len(data) // 3] ^ 16]) + data[len(data) // 3 + 1:],
        )
        for turn in range(2):
            for number, (file, content) in enumerate(contents.items()):
                file.write_bytes(damages[(number + turn * 2) % len(damages)](content))
            self.serve_on_device()
        # Saved anew and whole: PoCL's binaries differ from build to build, so the checksum in front of each is what tells.
        mended = {file: file.read_bytes() for file in contents}
        for file, content in mended.items():
            self.assertEqual(content[:16].decode(), self.checksum(content[16:]), f"{file.name} was not saved anew")
        self.assertLess(self.serve_on_device(), 5)
        for file, content in mended.items():
            self.assertEqual(file.read_bytes(), content, f"{file.name} was not taken as it is")

    @staticmethod
    def checksum(data):
        value = 0xCBF29CE484222325
        for byte in data:
            value = (value ^ byte) * 0x100000001B3 & 0xFFFFFFFFFFFFFFFF
        return f"{value:016x}"

    def test_saved_programs_folder_cannot_be_used(self):
        moved = self.folder / "kernels-away"
        self.kernels.rename(moved)
        try:
            self.kernels.write_text("not a directory")
            self.serve_on_device()
        finally:
            self.kernels.unlink()
            moved.rename(self.kernels)

    def test_left_over_pocl_cache_of_the_same_process_number(self):
        """As in a container, where the daemon always has the same one."""
        damaged = self.damage(self.pocl_cache, random.Random(2))
        wrapper = self.folder / "wrapper"
        wrapper.write_text(f'#!/bin/sh\ncp -r "{damaged}" "{self.kernels}/pocl-$$"\nexec "{rig.PROGRAM}" "$@"\n')
        wrapper.chmod(0o755)
        for file in self.saved:
            file.unlink(missing_ok=True)
        real = os.environ["LODESTONE_BIN"]
        os.environ["LODESTONE_BIN"] = str(wrapper)
        try:
            self.serve_on_device()
        finally:
            os.environ["LODESTONE_BIN"] = real

    def test_left_over_pocl_caches_are_swept(self):
        for number in (4194300, 4194301):  # above what pid_max allows here or anywhere by default
            shutil.copytree(self.pocl_cache if self.pocl_cache.exists() else self.kernels, self.kernels / f"pocl-{number}", dirs_exist_ok=True)
        self.serve_on_device()
        self.assertEqual([p.name for p in self.kernels.iterdir() if p.name.startswith("pocl-")], [])

    def test_no_opencl_device(self):
        empty = self.folder / "no-vendors"
        empty.mkdir(exist_ok=True)
        env = {"OCL_ICD_VENDORS": str(empty) + "/"}
        began = time.monotonic()
        result = rig.lodestone("serve", "--data-dir", self.data, "--listen", "127.0.0.1:0", "--admin-listen", "off", env=env, timeout=20)
        self.assertLess(time.monotonic() - began, 5)
        self.assertEqual(result.returncode, 1)
        self.assertEqual(len(result.stderr.strip().splitlines()), 1, result.stderr)
        self.assertIn("no OpenCL device", result.stderr)
        self.assertIn('device = "host"', result.stderr)
        with rig.Daemon(self.data, "--disk-cache-mib", 0, env=env) as daemon:
            for path in PATHS:
                self.assertEqual(rig.digest(daemon.get(path).body), self.oracle.digest(path))
        devices = rig.lodestone("devices", env=env)
        self.assertEqual(devices.returncode, 1)
        # Work that needs no device goes on.
        self.assertEqual(rig.lodestone("verify", "--data-dir", self.data, env=env).returncode, 0)

    def test_unknown_device(self):
        result = rig.lodestone("serve", "--data-dir", self.data, "--listen", "127.0.0.1:0", "--admin-listen", "off", "--device", "no-such-device", timeout=20)
        self.assertEqual(result.returncode, 1)
        self.assertIn("no-such-device", result.stderr)


if __name__ == "__main__":
    unittest.main()
