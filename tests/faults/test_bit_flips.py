"""Flipped bits in the tile cache and in layers: never a wrong byte."""

import os
import pathlib
import random
import shutil
import tempfile
import unittest

import rig

PAGE = 4096


class FlipTest(unittest.TestCase):
    def setUp(self):
        self.folder = pathlib.Path(tempfile.mkdtemp(prefix="lodestone-flip-"))
        self.addCleanup(shutil.rmtree, self.folder)
        self.data = self.folder / "data"
        # 64 cells a tile: base level 3 of 7 x 6 tiles, values of about 8 KB.
        rig.ingest(self.data, rig.SAMPLE_DEM, "hills", "--posts-per-tile", 65)
        self.oracle = rig.Oracle(self.data)
        self.addCleanup(self.oracle.close)

    def check(self, daemon, path, allowed=(200,)):
        reply = daemon.get(path)
        self.assertTrue(daemon.is_alive(), f"{path}: {daemon.log()}")
        self.assertIn(reply.status, allowed, f"{path}: {reply.body[:300]}")
        if reply.status == 200:
            self.assertEqual(rig.digest(reply.body), self.oracle.digest(path), f"{path} from {rig.came_from(reply)}")
        else:
            self.assertEqual(reply.header("content-type"), "application/problem+json")
        return reply


class CacheFlipTest(FlipTest):
    TILES = 240

    def setUp(self):
        super().setUp()
        self.paths = [f"/tiles/hills/lsa/5/{n % 12}/{n // 12 % 10}.f32?seed={n}" for n in range(self.TILES)]
        self.file = self.data / "cache" / "data.mdb"
        self.bodies = {}
        with rig.Daemon(self.data) as daemon:
            for path in self.paths:
                self.bodies[path] = self.check(daemon, path).body
            self.assertEqual(daemon.stop(), 0)
        self.filled = self.file.read_bytes()

    def value_places(self):
        """Offset of every tile's body in the cache file."""
        places = {path: self.filled.find(body) for path, body in self.bodies.items()}
        self.assertGreater(sum(place > 0 for place in places.values()), self.TILES - 5)
        return {path: place for path, place in places.items() if place > 0}

    def test_flipped_values_are_made_again(self):
        rng = random.Random(1)
        places = self.value_places()
        for path, place in places.items():
            rig.flip_bit(self.file, place + rng.randrange(len(self.bodies[path])), rng.randrange(8))
        with rig.Daemon(self.data, "--memory-cache-mib", 0) as daemon:
            for path in self.paths:
                reply = self.check(daemon, path)
                if path in places:
                    self.assertEqual(rig.came_from(reply), "miss", path)
            self.assertGreaterEqual(daemon.metric("corrupt_records_total"), len(places))
            self.assertEqual(daemon.stop(), 0)
        with rig.Daemon(self.data, "--memory-cache-mib", 0) as daemon:
            sources = [rig.came_from(self.check(daemon, path)) for path in self.paths]
            self.assertGreater(sources.count("disk"), self.TILES * 9 // 10, "the entries were not written anew")
            self.assertEqual(daemon.metric("corrupt_records_total"), 0)

    def test_bits_flip_anywhere_before_a_start(self):
        rng = random.Random(2)
        touched = 0
        for flips in (1, 1, 1, 1, 2, 3, 5, 10, 50, 300):
            self.file.write_bytes(self.filled)
            for _ in range(flips):
                rig.flip_random_bit(rng, self.file)
            with rig.Daemon(self.data, "--memory-cache-mib", 0) as daemon:
                self.assertLess(daemon.start_s, 5)
                for path in self.paths[::3]:
                    self.check(daemon, path)
                touched += daemon.metric("corrupt_records_total")
        self.assertGreater(touched, 0)

    def test_page_headers_flip_before_a_start(self):
        rng = random.Random(3)
        for _ in range(12):
            self.file.write_bytes(self.filled)
            for _ in range(2):
                rig.flip_bit(self.file, rng.randrange(len(self.filled) // PAGE) * PAGE + rng.randrange(16), rng.randrange(8))
            with rig.Daemon(self.data, "--memory-cache-mib", 0) as daemon:
                for path in self.paths[::4]:
                    self.check(daemon, path)

    def test_bits_flip_under_a_running_daemon(self):
        rng = random.Random(4)
        with rig.Daemon(self.data, "--memory-cache-mib", 0) as daemon:
            flips = 0
            for turn in range(300):
                try:
                    rig.flip_random_bit(rng, self.file)
                    flips += 1
                except (FileNotFoundError, ValueError):
                    pass  # caught between a damaged file and the new one: not there yet, or still empty
                self.check(daemon, rng.choice(self.paths))
                self.check(daemon, f"/tiles/hills/lsa/4/{turn % 8}/{turn % 6}.f32?seed={turn}")
            self.assertGreater(flips, 250)
            self.assertGreater(daemon.metric("corrupt_records_total"), 0)
            self.assertEqual(daemon.stop(), 0)

    def test_verify_counts_and_repairs(self):
        places = list(self.value_places().items())[:20]
        for path, place in places:
            rig.flip_bit(self.file, place + 100, 3)
        found = rig.lodestone("verify", "--data-dir", self.data)
        self.assertEqual(found.returncode, 3, found.stdout + found.stderr)
        self.assertIn(f"{len(places)} corrupt", found.stdout)
        repaired = rig.lodestone("verify", "--repair", "--data-dir", self.data)
        self.assertIn("removed", repaired.stdout)
        self.assertEqual(rig.lodestone("verify", "--data-dir", self.data).returncode, 0)

    def test_truncated_file(self):
        for size in (0, 1, 4096, 8192, len(self.filled) // 2, len(self.filled) - 1):
            self.file.write_bytes(self.filled[:size])
            with rig.Daemon(self.data, "--memory-cache-mib", 0) as daemon:
                for path in self.paths[::20]:
                    self.check(daemon, path)


class LayerFlipTest(FlipTest):
    def setUp(self):
        super().setUp()
        self.file, = self.data.glob("layers/hills/gen-*/data.mdb")
        self.sound = self.file.read_bytes()
        self.paths = [f"/tiles/hills/lsa/3/{x}/{y}.f32" for x in range(7) for y in range(6)]
        self.paths += [f"/tiles/hills/lsa/5/{x}/{y}.f32" for x in range(0, 26, 5) for y in range(0, 22, 5)]
        self.paths += ["/tiles/hills/linear/0/0/0.f32", "/tiles/hills/linear/1/1/1.f32", "/tiles/hills/linear/2/3/2.f32"]

    def serve_damaged(self, where):
        """(answers that were errors, layer opened at all, counter)."""
        with rig.Daemon(self.data, "--disk-cache-mib", 0, "--memory-cache-mib", 0) as daemon:
            is_open = daemon.get("/readyz").json()["status"] == "ready"
            errors = 0
            for path in self.paths:
                errors += self.check(daemon, path, allowed=(200, 500, 503)).status != 200
            counter = daemon.metric("corrupt_records_total")
            self.assertEqual(daemon.stop(), 0, where)
            return errors, is_open, counter

    def verify(self, where):
        result = rig.lodestone("verify", "--data-dir", self.data)
        self.assertIn(result.returncode, (0, 1, 3), f"{where}: {result.returncode} {result.stderr}")
        if result.returncode != 0:
            self.assertIn("hills", result.stdout + result.stderr, where)
        return result.returncode

    def test_one_flipped_value(self):
        """A byte in the middle of a stored tile: only the tiles that need it fail, and verify says which it is."""
        rng = random.Random(5)
        hurt = 0
        for _ in range(12):
            offset = (rng.randrange(8, len(self.sound) // PAGE - 8)) * PAGE + 2000
            self.file.write_bytes(self.sound)
            rig.flip_bit(self.file, offset, rng.randrange(8))
            errors, is_open, counter = self.serve_damaged(offset)
            status = self.verify(offset)
            if not is_open:  # it was the layer's own description
                self.assertEqual(errors, len(self.paths))
                self.assertEqual(status, 3)
            elif errors:
                hurt += 1
                self.assertLess(errors, len(self.paths) // 2, f"a flip at {offset} takes down most tiles")
                self.assertGreater(counter, 0)
                self.assertEqual(status, 3)
        self.assertGreater(hurt, 2)

    def test_flips_anywhere(self):
        rng = random.Random(6)
        found = 0
        for flips in (1, 1, 1, 1, 1, 1, 2, 4, 8, 64):
            self.file.write_bytes(self.sound)
            offsets = [rig.flip_random_bit(rng, self.file) for _ in range(flips)]
            errors, is_open, _ = self.serve_damaged(offsets)
            status = self.verify(offsets)
            found += status != 0
            if errors or not is_open:
                self.assertNotEqual(status, 0, f"tiles fail, but verify is content: {offsets}")
        self.assertGreater(found, 4)

    def test_flips_in_page_headers(self):
        """What LMDB itself believes: page numbers, flags, bounds, node offsets, the two meta pages."""
        rng = random.Random(7)
        pages = len(self.sound) // PAGE
        for turn in range(40):
            self.file.write_bytes(self.sound)
            page = turn % 2 if turn < 16 else rng.randrange(2, pages)
            offset = page * PAGE + rng.randrange(150 if page < 2 else 64)
            rig.flip_bit(self.file, offset, rng.randrange(8))
            with self.subTest(offset=offset):
                errors, is_open, _ = self.serve_damaged(offset)
                status = self.verify(offset)
                if errors or not is_open:
                    self.assertNotEqual(status, 0, "tiles fail, but verify is content")

    def test_truncated_layer(self):
        for size in (0, 100, PAGE, 2 * PAGE, len(self.sound) // 2, len(self.sound) - PAGE):
            self.file.write_bytes(self.sound[:size])
            with self.subTest(size=size):
                errors, _, _ = self.serve_damaged(size)
                self.assertGreater(errors, 0)
                self.assertNotEqual(self.verify(size), 0)

    def test_other_layers_stay(self):
        rig.ingest(self.data, rig.SAMPLE_DEM, "sound")
        self.file.write_bytes(os.urandom(len(self.sound)))
        with rig.Daemon(self.data) as daemon:
            self.assertEqual(daemon.get("/tiles/sound/lsa/2/1/1.f32").status, 200)
            self.assertGreaterEqual(daemon.get("/tiles/hills/lsa/2/1/1.f32").status, 500)
            self.assertEqual(daemon.get("/readyz").json()["status"], "degraded")
        rig.ingest(self.data, rig.SAMPLE_DEM, "hills", "--posts-per-tile", 65)
        with rig.Daemon(self.data) as daemon:
            for path in self.paths:
                self.check(daemon, path)


if __name__ == "__main__":
    unittest.main()
