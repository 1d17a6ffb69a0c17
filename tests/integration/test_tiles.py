"""Tiles over HTTP: pure functions of their address, without seams, anchored to the data, the same in every format."""

import json
import math
import random
import subprocess
import unittest

import lodestone_daemon as ld
from lodestone_daemon import BIG, SMALL, Grid

# Base level of BIG is 1 (2 x 2 tiles), of SMALL 3 (7 x 6 tiles).
PURITY_PATHS = tuple(
    [f'/tiles/{BIG}/{recipe}/{address}.f32?seed=7' for recipe in ld.ALL_RECIPES for address in ('1/0/0', '3/2/1', '6/40/33')] +
    [f'/tiles/{SMALL}/{recipe}/{address}.f32' for recipe in ld.WAVELET_RECIPES for address in ('2/1/1', '4/3/3', '4/12/10', '19/70000/50000')] +
    [f'/tiles/{BIG}/lsa/3/5/2.{ext}' for ext in ('exr', 'exr?compression=zip', 'exr?compression=piz&channels=Y,provenance',
                                                'exr?compression=pxr24', 'exr?pixel=half', 'tif', 'png', 'png?encoding=mapbox',
                                                'png?encoding=hillshade', 'png?encoding=relief&size=257', 'f32?quantum=auto')])


def setUpModule():
    global workspace
    workspace = ld.Workspace()


def tearDownModule():
    workspace.remove()


class Purity(unittest.TestCase):
    """The bytes depend on the address alone: not on order, caches, workers, device, work-group size or the process."""

    @classmethod
    def setUpClass(cls):
        cls.reference = {}
        cls.data_dir = workspace.data_dir()
        with ld.Daemon(cls.data_dir) as daemon:
            for path in PURITY_PATHS:
                reply = daemon.get(path)
                if reply.status != 200:
                    raise AssertionError(f'{path}: {reply}')
                cls.reference[path] = (reply.body, reply.header('etag'))
            assert daemon.stop() == 0

    def check(self, daemon, paths):
        for path in paths:
            reply = daemon.get(path)
            self.assertEqual(reply.status, 200, f'{path}: {reply}')
            self.assertEqual(reply.header('etag'), self.reference[path][1], path)
            self.assertTrue(reply.body == self.reference[path][0], f'{path}: other bytes than before')

    def test_the_same_bytes_twice_and_the_second_from_memory(self):
        with ld.Daemon(workspace.data_dir()) as daemon:
            self.check(daemon, PURITY_PATHS)
            made = daemon.generated()
            self.assertEqual(made, len(PURITY_PATHS))
            self.check(daemon, PURITY_PATHS)
            self.assertEqual(daemon.generated(), made)
            self.assertIn('desc=memory', daemon.get(PURITY_PATHS[0]).header('server-timing'))
            self.assertEqual(daemon.complaints(), [])

    def test_the_same_bytes_after_a_restart_from_disk(self):
        with ld.Daemon(self.data_dir) as daemon:
            self.check(daemon, PURITY_PATHS)
            self.assertEqual(daemon.generated(), 0)
            self.assertGreaterEqual(daemon.metrics()['lodestone_cache_hits_total{tier="disk"}'], len(PURITY_PATHS))
            daemon.restart(hard=True)
            self.check(daemon, PURITY_PATHS)

    def test_any_order_and_no_caches(self):
        with ld.Daemon(workspace.data_dir(), '--memory-cache-mib', '0', '--disk-cache-mib', '0', '--workers', '1') as daemon:
            for shuffle_seed in (1, 2):
                paths = list(PURITY_PATHS)
                random.Random(shuffle_seed).shuffle(paths)
                self.check(daemon, paths)
            self.assertEqual(daemon.generated(), 2 * len(PURITY_PATHS))

    def test_plain_cpp_gives_the_bits_of_the_device(self):
        with ld.Daemon(workspace.data_dir(), '--device', 'host', '--workers', '2') as daemon:
            self.assertIn('device="host"', daemon.get('/metrics').body.decode())
            self.check(daemon, PURITY_PATHS)

    def test_any_pocl_driver_and_work_group_size(self):
        for devices, local_size, workers in (('pthread', 1, 2), ('basic basic', 16, 1), ('basic', 256, 2)):
            with self.subTest(devices=devices, local_size=local_size):
                with ld.Daemon(workspace.data_dir(), '--local-size', str(local_size), '--workers', str(workers),
                               env={'POCL_DEVICES': devices}) as daemon:
                    self.check(daemon, PURITY_PATHS)
                    self.assertEqual(daemon.complaints(), [])


class DaemonCase(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.daemon = ld.Daemon(workspace.data_dir())
        cls.addClassCleanup(cls.daemon.kill)

    def grid(self, layer, recipe, z, x, y, query=''):
        return Grid.square(self.daemon.tile(layer, recipe, z, x, y, 'f32', query).f32())


class Ground(DaemonCase):
    """What the heights are."""

    def test_neighbours_share_their_edge_posts(self):
        for recipe in ld.ALL_RECIPES:
            for layer, z, x, y in ((SMALL, 2, 1, 1), (SMALL, 3, 2, 2), (SMALL, 4, 5, 3), (SMALL, 7, 63, 47), (SMALL, 12, 2047, 1023),
                                   (BIG, 1, 0, 0), (BIG, 9, 255, 100)):
                with self.subTest(recipe=recipe, layer=layer, z=z):
                    here = self.grid(layer, recipe, z, x, y)
                    east = self.grid(layer, recipe, z, x + 1, y)
                    south = self.grid(layer, recipe, z, x, y + 1)
                    last = here.width - 1
                    self.assertEqual(here.column(last).tobytes(), east.column(0).tobytes())
                    self.assertEqual(here.row(last).tobytes(), south.row(0).tobytes())

    def test_the_base_level_is_the_source(self):
        source = ld.sample_heights()
        description = self.daemon.layer(BIG)
        self.assertEqual((description['width_posts'], description['height_posts']), (source.width, source.height))
        for layer, z in ((BIG, 1), (SMALL, 3)):
            for recipe in ('linear', 'lsa'):
                for x, y in ((0, 0), (1, 1)):
                    tile = self.grid(layer, recipe, z, x, y)
                    cells = tile.width - 1
                    for row in range(min(tile.height, source.height - y * cells)):
                        width = min(tile.width, source.width - x * cells)
                        start = (y * cells + row) * source.width + x * cells
                        self.assertEqual(list(tile.row(row)[:width]), list(source.values[start:start + width]), f'{layer} {x} {y} row {row}')

    def test_coarser_levels_are_the_analysis_of_the_source(self):
        level = ld.sample_heights()
        for z in (2, 1, 0):
            level = ld.analysed(level)
            tile = self.grid(SMALL, 'gsa', z, 0, 0)
            for row in range(min(tile.height, level.height)):
                for got, wanted in zip(tile.row(row), level.row(row)):
                    self.assertAlmostEqual(got, wanted, delta=4 * 2 ** -21 * 1100, msg=f'level {z}, row {row}')

    def test_the_analysis_of_a_synthetic_level_is_the_level_above(self):
        for recipe in ld.WAVELET_RECIPES:
            for z, x, y in ((3, 2, 3), (4, 5, 4), (8, 100, 77)):
                with self.subTest(recipe=recipe, z=z):
                    parent = self.grid(SMALL, recipe, z, x, y)
                    quarter = {(dx, dy): self.grid(SMALL, recipe, z + 1, 2 * x + dx, 2 * y + dy) for dx in (0, 1) for dy in (0, 1)}
                    values = []
                    for row in range(129):
                        dy, line = (0, row) if row < 65 else (1, row - 64)
                        values += list(quarter[0, dy].row(line)) + list(quarter[1, dy].row(line))[1:]
                    coarse = ld.analysed(Grid(129, 129, values))
                    bound = 2 * 2 ** -21 * max(abs(h) for h in values)
                    # At the assembly's own border the filter would need posts beyond it.
                    worst = max(abs(coarse.at(i, j) - parent.at(i, j)) for i in range(1, 64) for j in range(1, 64))
                    self.assertLessEqual(worst, bound)
                    changed = max(abs(a - b) for a, b in zip(self.grid(SMALL, 'linear', z + 1, 2 * x, 2 * y).values, quarter[0, 0].values))
                    self.assertEqual(changed > 0, recipe != 'linear')

    def test_linear_is_bilinear_between_the_posts(self):
        parent = self.grid(SMALL, 'linear', 3, 2, 1)
        child = self.grid(SMALL, 'linear', 4, 5, 3)  # the south-east quarter
        for j in range(0, 65):
            for i in range(0, 65):
                column, row = 32 + i / 2, 32 + j / 2
                c, r = min(int(column), 63), min(int(row), 63)
                fx, fy = column - c, row - r
                wanted = (parent.at(c, r) * (1 - fx) + parent.at(c + 1, r) * fx) * (1 - fy) + \
                    (parent.at(c, r + 1) * (1 - fx) + parent.at(c + 1, r + 1) * fx) * fy
                self.assertEqual(child.at(i, j), wanted, (i, j))

    def test_seeds_give_other_ground_of_the_same_kind(self):
        linear = self.grid(BIG, 'linear', 4, 3, 3)
        bodies, deviations = set(), []
        for seed in (0, 1, 2 ** 31, 2 ** 63 - 1, 2 ** 64 - 1):
            reply = self.daemon.tile(BIG, 'gsa', 4, 3, 3, 'f32', f'seed={seed}')
            bodies.add(reply.body)
            heights = reply.f32()
            self.assertTrue(all(math.isfinite(h) for h in heights))
            detail = [a - b for a, b in zip(heights, linear.values)]
            mean = math.fsum(detail) / len(detail)
            deviations.append(math.sqrt(math.fsum((d - mean) ** 2 for d in detail) / len(detail)))
        self.assertEqual(len(bodies), 5)
        self.assertGreater(min(deviations), 0.1)
        self.assertLess(max(deviations) / min(deviations), 1.15, deviations)
        self.assertEqual(self.daemon.tile(BIG, 'gsa', 4, 3, 3).body, self.daemon.tile(BIG, 'gsa', 4, 3, 3, 'f32', 'seed=0').body)

    def test_all_numbers_are_finite_to_the_last_level(self):
        deepest = self.daemon.layer(SMALL)['max_level']
        self.assertEqual(deepest, 3 + 16)
        for recipe in ld.ALL_RECIPES:
            for z in (5, 10, deepest):
                last_x, last_y = (402 << (z - 3)) - 1 >> 6, (343 << (z - 3)) - 1 >> 6
                for x, y in ((0, 0), (last_x, last_y)):
                    tile = self.grid(SMALL, recipe, z, x, y)
                    self.assertTrue(all(-1000 < h < 3000 for h in tile.values), f'{recipe} {z}/{x}/{y}')

    def test_provenance_is_told(self):
        for address, wanted in (('1/0/0', 'surveyed'), ('0/0/0', None), ('4/3/3', 'synthetic')):
            reply = self.daemon.get(f'/tiles/{BIG}/lsa/{address}.exr?channels=Y,provenance')
            told = {part.strip() for part in reply.header('lodestone-provenance').split(',')}
            _, channels = ld.read_exr(reply.body)
            words = {0: 'surveyed', 1: 'filled', 2: 'synthetic'}
            self.assertEqual(told, {words[int(p)] for p in set(channels['provenance'])}, address)
            if wanted:
                self.assertEqual(told, {wanted})


class Formats(DaemonCase):
    """One ground, many files."""

    def test_exr_holds_the_very_floats(self):
        for z, x, y in ((1, 1, 0), (5, 17, 9)):
            raw = self.daemon.tile(BIG, 'lsa', z, x, y)
            for query in ('compression=none', 'compression=zip', ''):
                attributes, channels = ld.read_exr(self.daemon.tile(BIG, 'lsa', z, x, y, 'exr', query).body)
                self.assertEqual(list(channels), ['Y'])
                self.assertEqual(channels['Y'].tobytes(), raw.f32().tobytes(), query)
                wanted = {'layer': BIG, 'recipe': 'lsa', 'revision': self.daemon.layer()['revision'], 'crs': 'EPSG:4326', 'datum': 'EGM96',
                          'seed': '0', 'tile': f'{z}/{x}/{y}'}
                self.assertEqual({name: ld.exr_text(attributes, name) for name in wanted}, wanted)

    def test_half_is_within_the_error_that_the_header_tells(self):
        raw = self.daemon.tile(BIG, 'lsa', 4, 3, 3).f32()
        for query in ('compression=none&pixel=half', 'compression=zip&pixel=half', 'compression=none&quantum=0.125'):
            reply = self.daemon.tile(BIG, 'lsa', 4, 3, 3, 'exr', query)
            told = float(reply.header('lodestone-max-error-m'))
            worst = max(abs(a - b) for a, b in zip(raw, ld.read_exr(reply.body)[1]['Y']))
            self.assertGreater(worst, 0)
            self.assertLessEqual(worst, told)
            self.assertLess(told, 1)

    def test_quantum_is_exact_and_keeps_edges(self):
        here, east = (Grid.square(self.daemon.tile(BIG, 'lsa', 4, x, 3, 'f32', 'quantum=0.25').f32()) for x in (3, 4))
        self.assertTrue(all(h * 4 == round(h * 4) for h in here.values))
        self.assertEqual(here.column(256).tobytes(), east.column(0).tobytes())

    def test_terrarium_and_mapbox_pixels_are_the_heights(self):
        raw = self.daemon.tile(BIG, 'lsa', 4, 3, 3).f32()
        for encoding, height_of, bound in (('terrarium', lambda r, g, b: r * 256 + g + b / 256 - 32768, 1 / 512 + 1e-4),
                                           ('mapbox', lambda r, g, b: -10000 + (r * 65536 + g * 256 + b) * 0.1, 0.0502)):
            reply = self.daemon.tile(BIG, 'lsa', 4, 3, 3, 'png', f'encoding={encoding}&size=257')
            width, height, channels, pixels = ld.read_png(reply.body)
            self.assertEqual((width, height, channels), (257, 257, 3))
            worst = max(abs(height_of(*pixels[3 * n:3 * n + 3]) - raw[n]) for n in range(257 * 257))
            self.assertLessEqual(worst, bound)
            self.assertLessEqual(worst, float(reply.header('lodestone-max-error-m')) + 2e-4)
            centres = ld.read_png(self.daemon.tile(BIG, 'lsa', 4, 3, 3, 'png', f'encoding={encoding}').body)
            self.assertEqual(centres[:3], (256, 256, 3))
            grid = Grid.square(raw)
            for i, j in ((0, 0), (100, 200), (255, 255)):
                at = 3 * (j * 256 + i)
                mean = (grid.at(i, j) + grid.at(i + 1, j) + grid.at(i, j + 1) + grid.at(i + 1, j + 1)) / 4
                self.assertAlmostEqual(height_of(*centres[3][at:at + 3]), mean, delta=bound + 1e-3)

    def test_pictures_are_pictures(self):
        for encoding in ('hillshade', 'relief'):
            for z, x, y in ((0, 0, 0), (3, 2, 2)):
                width, height, channels, pixels = ld.read_png(self.daemon.tile(BIG, 'lsa', z, x, y, 'png', f'encoding={encoding}').body)
                self.assertEqual((width, height), (256, 256))
                self.assertGreater(len(set(pixels)), 20)

    def test_geotiff_opens_in_gdal_with_place_and_heights(self):
        path, flat = workspace.path('tile.tif'), workspace.path('tile.raw')
        z, x, y = 4, 3, 3
        with open(path, 'wb') as file:
            file.write(self.daemon.tile(BIG, 'lsa', z, x, y, 'tif').body)
        told = json.loads(subprocess.run(['gdalinfo', '-json', path], check=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE).stdout)
        self.assertEqual(told['size'], [257, 257])
        self.assertEqual(told['bands'][0]['type'], 'Float32')
        self.assertIn('WGS 84', told['coordinateSystem']['wkt'])
        t = self.daemon.layer()['transform']
        step = t[1] / 8
        is_point = told.get('metadata', {}).get('', {}).get('AREA_OR_POINT') == 'Point'
        half = 0.5  # GDAL tells the pixel's corner for points too
        west, north = t[0] + x * 256 * step, t[3] - y * 256 * step
        self.assertTrue(is_point, told.get('metadata'))
        self.assertAlmostEqual(told['geoTransform'][0], west - half * step, delta=step * 1e-6)
        self.assertAlmostEqual(told['geoTransform'][3], north + half * step, delta=step * 1e-6)
        self.assertAlmostEqual(told['geoTransform'][1], step, delta=step * 1e-9)
        subprocess.run(['gdal_translate', '-q', '-of', 'ENVI', path, flat], check=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        with open(flat, 'rb') as file:
            self.assertEqual(file.read(), self.daemon.tile(BIG, 'lsa', z, x, y).body)

    def test_content_types_and_lengths(self):
        for ext, kind, magic in (('exr', 'image/x-exr', b'\x76\x2f\x31\x01'), ('tif', 'image/tiff', b'II'), ('png', 'image/png', b'\x89PNG'),
                                 ('f32', 'application/octet-stream', b'')):
            reply = self.daemon.tile(BIG, 'lsa', 3, 3, 3, ext)
            self.assertEqual(reply.header('content-type'), kind)
            self.assertEqual(reply.header('x-content-type-options'), 'nosniff')
            self.assertEqual(int(reply.header('content-length')), len(reply.body))
            self.assertTrue(reply.body.startswith(magic))
        self.assertEqual(len(self.daemon.tile(BIG, 'lsa', 3, 3, 3, 'f32').body), 257 * 257 * 4)


class Conditions(DaemonCase):
    """ETag, If-None-Match, ?v=, HEAD, Server-Timing."""
    path = f'/tiles/{BIG}/lsa/3/4/4.exr'

    def test_if_none_match_forms(self):
        etag = self.daemon.get(self.path).header('etag')
        self.assertRegex(etag, r'^"[^"]+"$')
        for form in (etag, 'W/' + etag, f'"other", {etag}', f'"a,b",W/{etag} , "c"', '*'):
            reply = self.daemon.get(self.path, {'If-None-Match': form})
            self.assertEqual((reply.status, reply.body), (304, b''), form)
            self.assertEqual(reply.header('etag'), etag)
            self.assertIn('max-age', reply.header('cache-control'))
        for form in ('"other"', etag.strip('"'), etag[:-1], '', 'W/"x", "y"', etag[:-2] + '0"' if etag[-2] != '0' else etag[:-2] + '1"'):
            reply = self.daemon.get(self.path, {'If-None-Match': form})
            self.assertEqual(reply.status, 200, form)
            self.assertGreater(len(reply.body), 1000)

    def test_not_modified_costs_no_tile(self):
        etag = self.daemon.get(self.path).header('etag')
        with ld.Daemon(workspace.data_dir()) as cold:
            reply = cold.get(self.path, {'If-None-Match': etag})
            self.assertEqual(reply.status, 304)
            metrics = cold.metrics()
            self.assertEqual(metrics['lodestone_tiles_generated_total'], 0)
            self.assertEqual(metrics['lodestone_not_modified_total'], 1)

    def test_every_variant_has_its_own_etag(self):
        paths = [p for p in PURITY_PATHS if '/lsa/3/5/2' in p] + [f'/tiles/{BIG}/lsa/3/5/2.f32?seed={s}' for s in (0, 1)]
        etags = [self.daemon.get(path).header('etag') for path in paths]
        self.assertEqual(len(set(etags)), len(etags))

    def test_head_is_get_without_body(self):
        for path in (self.path, f'/tiles/{BIG}/gsa/5/4/4.f32', f'/layers/{BIG}', f'/tiles/{BIG}/lsa/3/4/999999.exr'):
            head, get = self.daemon.request('HEAD', path), self.daemon.get(path)
            self.assertEqual(head.status, get.status)
            self.assertEqual(head.body, b'')
            for name in ('content-type', 'content-length', 'etag', 'cache-control', 'lodestone-provenance'):
                self.assertEqual(head.header(name), get.header(name), f'{path}: {name}')

    def test_revision_in_the_address(self):
        revision = self.daemon.layer()['revision']
        self.assertRegex(revision, '^[0-9a-f]{16}$')
        pinned = self.daemon.get(f'{self.path}?v={revision}')
        self.assertEqual(pinned.status, 200)
        self.assertIn('immutable', pinned.header('cache-control'))
        self.assertIn('public', pinned.header('cache-control'))
        plain = self.daemon.get(self.path)
        self.assertNotIn('immutable', plain.header('cache-control'))
        self.assertEqual(pinned.body, plain.body)
        self.assertEqual(pinned.header('etag'), plain.header('etag'))
        old = self.daemon.get(f'{self.path}?v=0123456789abcdef')
        self.assertEqual(old.status, 410)
        self.assertIn(revision, old.json()['detail'])
        for wrong in ('', 'zz', revision + '0', revision.upper() + 'X', '..'):
            self.assertEqual(self.daemon.get(f'{self.path}?v={wrong}').status, 400, wrong)

    def test_server_timing_tells_cache_queue_ground_and_encoding(self):
        path = f'/tiles/{BIG}/lsa/6/9/9.f32'
        cold, warm = self.daemon.get(path).header('server-timing'), self.daemon.get(path).header('server-timing')
        self.assertRegex(cold, r'cache;desc=miss, queue;dur=[0-9.]+, ground;dur=[0-9.]+, encode;dur=[0-9.]+')
        self.assertEqual(warm, 'cache;desc=memory')


if __name__ == '__main__':
    unittest.main()
