"""EXR tiles in other people's readers: OpenImageIO, exrheader and three.js. Equal values, row 0 north."""
import array
import json
import pathlib
import struct
import subprocess
import tempfile
import unittest

from clients import HERE, install_packages
import lodestone_daemon as ld

ADDRESS = (3, 2, 2)


class ExrClients(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        install_packages()
        cls.workspace = ld.Workspace()
        cls.addClassCleanup(cls.workspace.remove)
        cls.daemon = ld.Daemon(cls.workspace.data_dir())
        cls.addClassCleanup(cls.daemon.stop)
        cls.truth = array.array('f', cls.daemon.tile(ld.BIG, 'lsa', *ADDRESS).body)
        cls.folder = pathlib.Path(tempfile.mkdtemp(prefix='lodestone-exr-'))

    def exr(self, query):
        path = self.folder / (query.replace('=', '-').replace('&', '-') + '.exr')
        reply = self.daemon.tile(ld.BIG, 'lsa', *ADDRESS, ext='exr', query=query)
        self.assertEqual(reply.status, 200, reply)
        path.write_bytes(reply.body)
        return path

    def assert_same_heights(self, heights, tolerance, label):
        self.assertEqual(len(heights), len(self.truth), label)
        if tolerance == 0:
            self.assertEqual(array.array('f', heights).tobytes(), self.truth.tobytes(), label)
            return
        worst = max(abs(a - b) for a, b in zip(heights, self.truth))
        self.assertLessEqual(worst, tolerance, label)

    # Largest difference from the float tile, metres, for heights up to 1024 m.
    VARIANTS = {'compression=none': 0, 'compression=zip': 0, 'compression=piz': 0, 'compression=pxr24': 2 ** -6, 'pixel=half&compression=zip': 0.5}

    def test_three_js(self):
        for query, tolerance in self.VARIANTS.items():
            path = self.exr(query)
            out = path.with_suffix('.three.f32')
            ran = subprocess.run(['node', HERE / 'read_exr.mjs', path, out], capture_output=True, text=True)
            self.assertEqual(ran.returncode, 0, ran.stderr[-2000:])
            size = json.loads(ran.stdout)
            self.assertEqual((size['width'], size['height']), (257, 257))
            heights = array.array('f', out.read_bytes())
            # The loader hands out rows from the south, as WebGL textures have them.
            northwards = array.array('f')
            for row in reversed(range(257)):
                northwards.extend(heights[row * 257:(row + 1) * 257])
            self.assert_same_heights(northwards, tolerance, f'three.js, {query}')

    def test_openimageio(self):
        for query, tolerance in self.VARIANTS.items():
            heights = self.read_by_oiio(self.exr(query))
            self.assert_same_heights(heights, tolerance, f'OpenImageIO, {query}')

    @staticmethod
    def read_by_oiio(path, *operations):
        out = path.with_suffix('.tif')
        subprocess.run(['oiiotool', path, *operations, '-d', 'float', '--compression', 'none', '-o', out], check=True, capture_output=True)
        raw = path.with_suffix('.bin')
        subprocess.run(['gdal_translate', '-q', '-of', 'ENVI', out, raw], check=True, capture_output=True)
        return array.array('f', raw.read_bytes())

    def test_exrheader(self):
        text = subprocess.run(['exrheader', self.exr('compression=zip')], check=True, capture_output=True, text=True).stdout
        for expected in ('Y, 32-bit floating-point', f'layer (type string): "{ld.BIG}"', 'recipe (type string): "lsa"', 'tile (type string): "3/2/2"',
                         'seed (type string): "0"', 'compression (type compression): zip', 'dataWindow (type box2i): (0 0) - (256 256)'):
            self.assertIn(expected, text)

    def test_provenance_channel(self):
        path = self.exr('channels=Y,provenance')
        text = subprocess.run(['exrheader', path], check=True, capture_output=True, text=True).stdout
        self.assertIn('provenance, 16-bit floating-point', text)
        self.assertEqual(set(self.read_by_oiio(path, '--ch', 'provenance')), {2.0})  # a synthetic level, no voids in the sample

    def test_bytes_of_a_float_are_little_endian(self):
        first = struct.unpack('<f', self.truth.tobytes()[:4])[0]
        self.assertTrue(-500 < first < 9000, first)


if __name__ == '__main__':
    unittest.main()
