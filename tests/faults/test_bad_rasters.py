"""Broken and hostile rasters through `lodestone ingest`: refused in order, never a crash, the old layer intact."""

import concurrent.futures
import os
import pathlib
import random
import shutil
import subprocess
import tempfile
import threading
import time
import unittest

import rig

WORKERS = 4
# name, creation options of gdal_translate
TEMPLATES = (
    ("plain.tif", ["-of", "GTiff"]),
    ("deflate.tif", ["-of", "GTiff", "-co", "COMPRESS=DEFLATE", "-co", "PREDICTOR=2"]),
    ("lzw.tif", ["-of", "GTiff", "-ot", "Float32", "-co", "COMPRESS=LZW", "-co", "PREDICTOR=3"]),
    ("tiled.tif", ["-of", "GTiff", "-ot", "Float64", "-co", "TILED=YES", "-co", "BLOCKXSIZE=16", "-co", "BLOCKYSIZE=16", "-co", "COMPRESS=ZSTD"]),
    ("packbits.tif", ["-of", "GTiff", "-ot", "UInt16", "-co", "COMPRESS=PACKBITS"]),
    ("big.tif", ["-of", "GTiff", "-co", "BIGTIFF=YES", "-co", "COMPRESS=LZMA"]),
    ("grid.asc", ["-of", "AAIGrid"]),
    ("picture.png", ["-of", "PNG", "-ot", "UInt16", "-co", "WORLDFILE=YES"]),
    ("wavelet.jp2", ["-of", "JP2OpenJPEG", "-ot", "UInt16"]),
)
CUTS, FLIPS = 12, 46  # of each template


class BadRasterTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = pathlib.Path(tempfile.mkdtemp(prefix="lodestone-rasters-"))
        cls.addClassCleanup(shutil.rmtree, cls.folder)
        cls.base = cls.folder / "base.tif"
        rig.write_geotiff(cls.base, 40, 40, compress=False)

    def setUp(self):
        self.spare = threading.local()
        self.made = 0
        self.lock = threading.Lock()

    def data_dir(self):
        """This thread's data directory with the old layer in it."""
        if not hasattr(self.spare, "data"):
            with self.lock:
                self.made += 1
                self.spare.data = self.folder / f"{self._testMethodName}-{self.made}"
            rig.ingest(self.spare.data, self.base, "old", "--posts-per-tile", 65)
            self.spare.files = self.layer_files(self.spare.data)
        return self.spare.data

    @staticmethod
    def layer_files(data):
        return {str(p.relative_to(data)): p.read_bytes() for p in data.rglob("*") if p.is_file() and p.name != "lock"}

    def try_ingest(self, raster):
        """Exit status. The old layer must survive a refusal; it is put back after a success."""
        data = self.data_dir()
        try:
            result = rig.lodestone("ingest", raster, "--layer", "old", "--posts-per-tile", 65, "--data-dir", data, timeout=20)
        except subprocess.TimeoutExpired:
            is_file = pathlib.Path(raster).is_file()
            self.fail(f"{raster} is still being read after 20 s; its bytes: {pathlib.Path(raster).read_bytes()[:8192].hex() if is_file else 'no file'}")
        self.assertIn(result.returncode, (0, 1, 2), f"{raster}: {result.returncode} {result.stderr}")
        if result.returncode != 0:
            self.assertEqual(self.layer_files(data), self.spare.files, f"{raster} changed the old layer")
            lines = [l for l in result.stderr.splitlines() if not l.rstrip().endswith(("read", "fill", "levels", "roughness", "publish"))]
            self.assertTrue(lines, f"{raster} was refused without a word")
        else:
            shutil.rmtree(data)
            for name, content in self.spare.files.items():
                (data / name).parent.mkdir(parents=True, exist_ok=True)
                (data / name).write_bytes(content)
        return result.returncode

    def test_cut_and_flipped_files(self):
        rng = random.Random(8)
        cases = []
        for name, options in TEMPLATES:
            sound = self.folder / "sound" / name
            sound.parent.mkdir(exist_ok=True)
            subprocess.run(["gdal_translate", "-q", *options, self.base, sound], check=True)
            content = sound.read_bytes()
            companions = [p for p in sound.parent.iterdir() if p.stem == sound.stem and p != sound or p.name.startswith(name + ".")]
            for number in range(CUTS + FLIPS):
                place = self.folder / "cases" / f"{sound.stem}-{number}"
                place.mkdir(parents=True)
                for companion in companions:
                    shutil.copy(companion, place)
                bad = bytearray(content)
                if number < CUTS:
                    bad = bad[:rng.randrange(len(bad))]
                else:
                    # Headers are where the decisions are: every other flip goes there.
                    span = len(bad) if number % 2 else min(len(bad), 512)
                    for _ in range(rng.choice((1, 1, 2, 8))):
                        bad[rng.randrange(span)] ^= 1 << rng.randrange(8)
                (place / name).write_bytes(bad)
                cases.append(place / name)
        self.assertGreaterEqual(len(cases), 500)
        with concurrent.futures.ThreadPoolExecutor(WORKERS) as pool:
            statuses = list(pool.map(self.try_ingest, cases))
        self.assertGreater(statuses.count(1), 100, "hardly anything was refused: the damage does not reach the reader")

    def bounded(self, raster):
        """Refused within seconds, in little memory, without filling the disk."""
        data = self.data_dir()
        began = time.monotonic()
        process = subprocess.Popen([rig.PROGRAM, "ingest", str(raster), "--layer", "old", "--data-dir", str(data)], stdout=subprocess.DEVNULL,
                                   stderr=subprocess.PIPE, text=True)
        try:
            _, said = process.communicate(timeout=15)
        except subprocess.TimeoutExpired:
            peak_mib = peak_memory_mib(process.pid)
            process.kill()
            process.communicate()
            self.fail(f"{raster.name} ({raster.stat().st_size} bytes) is still being read after 15 s, {peak_mib} MiB")
        self.assertEqual(process.returncode, 1, said)
        self.assertLess(time.monotonic() - began, 10)
        self.assertEqual(self.layer_files(data), self.spare.files)
        return said

    def test_deflate_bomb(self):
        """2401 tiles of 4096 x 4096 zeros that share their 32 KB: 80 GB declared in 52 KB."""
        bomb = self.folder / "bomb.tif"
        rig.write_geotiff(bomb, 0, 0, tile=4096, declared=(200000, 200000), shared_tile=True)
        self.assertLess(bomb.stat().st_size, 100_000)
        self.assertIn("200000 x 200000", self.bounded(bomb))

    def test_one_strip_bomb(self):
        bomb = self.folder / "strip.tif"
        rig.write_geotiff(bomb, 40, 40, declared=(200000, 200000))
        self.bounded(bomb)

    def test_sparse_raster(self):
        sparse = self.folder / "sparse.tif"
        subprocess.run(["gdal_create", "-q", "-of", "GTiff", "-outsize", "400000", "400000", "-bands", "1", "-ot", "Float32", "-co", "COMPRESS=DEFLATE",
                        "-co", "SPARSE_OK=TRUE", "-co", "TILED=YES", "-co", "BLOCKXSIZE=4096", "-co", "BLOCKYSIZE=4096", "-co", "BIGTIFF=YES",
                        "-a_srs", "EPSG:32617", "-a_ullr", "0", "6000000", "400000", "5600000", sparse], check=True, stdout=subprocess.DEVNULL)
        self.assertIn("400000 x 400000", self.bounded(sparse))

    def test_memory_of_a_large_raster_is_bounded(self):
        """24 million posts in a raster that packs well (but is no bomb): read in windows."""
        large = self.folder / "large.tif"
        subprocess.run(["gdal_translate", "-q", "-outsize", "6000", "4000", "-r", "bilinear", "-ot", "Float32", "-co", "COMPRESS=DEFLATE", "-co", "ZLEVEL=1",
                        rig.SAMPLE_DEM, large], check=True)
        process = subprocess.Popen([rig.PROGRAM, "ingest", str(large), "--layer", "large", "--data-dir", str(self.folder / "large-data")],
                                   stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        peak_mib = 0
        while process.poll() is None:
            peak_mib = max(peak_mib, peak_memory_mib(process.pid))
            time.sleep(0.02)
        said = process.stderr.read()
        process.stderr.close()
        self.assertEqual(process.returncode, 0, said)
        self.assertGreater(peak_mib, 0)
        self.assertLess(peak_mib, 512)

    def test_disguises(self):
        """Formats that reach other files or the network are refused whatever their name; nothing of what they name is shown."""
        vrt = ('<VRTDataset rasterXSize="20" rasterYSize="20"><SRS>EPSG:32617</SRS><GeoTransform>0,30,0,0,0,-30</GeoTransform>'
               '<VRTRasterBand dataType="Byte" band="1" subClass="VRTRawRasterBand"><SourceFilename relativetoVRT="0">/etc/passwd</SourceFilename>'
               '<ImageOffset>0</ImageOffset><PixelOffset>1</PixelOffset><LineOffset>20</LineOffset></VRTRasterBand></VRTDataset>')
        wms = "<GDAL_WMS><Service name='TMS'><ServerUrl>http://127.0.0.1:9/${z}/${x}/${y}</ServerUrl></Service></GDAL_WMS>"
        contents = {"vrt.tif": vrt, "vrt.png": vrt, "vrt.hgt": vrt, "wms.tif": wms, "empty.tif": "", "text.tif": "no raster at all\n" * 50,
                    "html.asc": "<html></html>", "json.tif": '{"type": "FeatureCollection"}'}
        for name, content in contents.items():
            path = self.folder / name
            path.write_text(content)
            with self.subTest(name=name):
                self.assertEqual(self.try_ingest(path), 1)
        shown = rig.lodestone("ingest", self.folder / "vrt.tif", "--layer", "x", "--data-dir", self.folder / "x")
        self.assertNotIn("root:", shown.stdout + shown.stderr)
        for source in ("/vsicurl/http://127.0.0.1:9/a.tif", "/vsizip/vsicurl/http://127.0.0.1:9/a.zip", "WMS:http://127.0.0.1:9/", "GTIFF_DIR:1:/etc/passwd",
                       vrt, self.folder, "/dev/null", "/proc/self/mem"):
            with self.subTest(source=str(source)[:40]):
                self.assertEqual(self.try_ingest(source), 1)

    def test_pipe_does_not_hang(self):
        pipe = self.folder / "pipe.tif"
        os.mkfifo(pipe)
        self.assertEqual(self.try_ingest(pipe), 1)


def peak_memory_mib(pid):
    try:
        status = pathlib.Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0
    return next((int(line.split()[1]) // 1024 for line in status.splitlines() if line.startswith("VmHWM")), 0)


if __name__ == "__main__":
    unittest.main()
