"""kill -9 of ingest at random moments: the old layer (or none) stays, the next run works, nothing is left lying about."""

import pathlib
import random
import shutil
import subprocess
import tempfile
import time
import unittest

import rig

KILLS = 24


class KillIngestTest(unittest.TestCase):
    def setUp(self):
        self.folder = pathlib.Path(tempfile.mkdtemp(prefix="lodestone-ingest-"))
        self.addCleanup(shutil.rmtree, self.folder)
        self.large = self.folder / "large.tif"
        subprocess.run(["gdal_translate", "-q", "-r", "bilinear", "-outsize", "1600", "1376", "-ot", "Float32", rig.SAMPLE_DEM, self.large], check=True)
        self.old = self.folder / "old"
        rig.ingest(self.old, rig.SAMPLE_DEM, "hills")
        self.old_digest = self.layer_digest(self.old)
        self.new = self.folder / "new"
        began = time.monotonic()
        rig.ingest(self.new, self.large, "hills")
        self.duration_s = time.monotonic() - began
        self.new_digest = self.layer_digest(self.new)

    def layer_digest(self, data):
        """Of a few tiles of the layer; None when there is no layer."""
        if rig.lodestone("inspect", "hills", "--data-dir", data).returncode != 0:
            return None
        with rig.Daemon(data, "--disk-cache-mib", 0) as daemon:
            bodies = b""
            for path in ("0/0/0.f32", "1/0/0.f32", "1/1/1.f32"):
                reply = daemon.get("/tiles/hills/lsa/" + path)
                self.assertEqual(reply.status, 200, reply.body[:300])
                bodies += reply.body
            return rig.digest(bodies)

    def test_layer_is_the_old_or_the_new_one(self):
        rng = random.Random(5)
        seen = set()
        for kill in range(KILLS):
            has_old = kill % 2 == 0
            data = self.folder / "data"
            if has_old:
                shutil.copytree(self.old, data)
            arguments = ["ingest", self.large, "--layer", "hills", "--data-dir", data]
            process = subprocess.Popen([rig.PROGRAM, *map(str, arguments)], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
            # Spread over the run, and a little beyond its end.
            time.sleep(self.duration_s * (kill + rng.random()) / KILLS * 1.1)
            process.kill()
            process.wait()
            found = self.layer_digest(data)
            allowed = {self.old_digest if has_old else None, self.new_digest}
            self.assertIn(found, allowed, f"kill {kill}, old layer: {has_old}")
            seen.add(found)
            if found is not None:
                verified = rig.lodestone("verify", "--data-dir", data)
                self.assertEqual(verified.returncode, 0, verified.stdout)
            if kill % 3 == 0:
                rig.ingest(data, self.large, "hills")
                self.assertEqual(self.layer_digest(data), self.new_digest)
                names = sorted(p.name for p in (data / "layers" / "hills").iterdir() if not p.name.startswith("gen-"))
                self.assertLessEqual(set(names), {"CURRENT", "lock", "masks", "zones", "imagery"})
                generations = [p.name for p in (data / "layers" / "hills").iterdir() if p.name.startswith("gen-")]
                self.assertEqual(len(generations), 1, generations)
            shutil.rmtree(data, ignore_errors=True)
        self.assertTrue({None, self.old_digest} & seen, "no kill came before publication")


if __name__ == "__main__":
    unittest.main()
