"""Masks through the admin listener: upload, effect on the ground, revisions, and everything that must be refused."""

import random
import subprocess
import unittest
import zlib

import lodestone_daemon as ld
from lodestone_daemon import BIG, SMALL, Grid

WIDTH, HEIGHT = 402, 343  # data cells of the sample


def setUpModule():
    global workspace
    workspace = ld.Workspace()


def tearDownModule():
    workspace.remove()


def west_half(column, _row):
    return 255 if column < WIDTH // 2 else 0


class Masks(unittest.TestCase):
    def setUp(self):
        self.daemon = ld.Daemon(workspace.data_dir(), '--device', 'host')
        self.addCleanup(self.daemon.kill)

    def put(self, body, name='roads', layer=SMALL, kind='image/png'):
        return self.daemon.admin('PUT', f'/layers/{layer}/masks/{name}', body, {'Content-Type': kind})

    def put_well(self, *arguments, **more):
        reply = self.put(*arguments, **more)
        self.assertIn(reply.status, (200, 201), reply)
        return reply

    def grid(self, recipe, z, x, y, query='', layer=SMALL):
        return Grid.square(self.daemon.tile(layer, recipe, z, x, y, 'f32', query).f32())

    def revision(self):
        return self.daemon.layer(SMALL)['revision']

    def test_put_get_delete(self):
        before = self.revision()
        plain = self.daemon.tile(SMALL, 'gsa', 4, 2, 2)
        listed = self.put_well(ld.make_png(WIDTH, HEIGHT, west_half))
        told = listed.json()
        self.assertEqual(listed.status, 201)
        self.assertEqual((told['name'], told['width'], told['height'], told['level']), ('roads', WIDTH, HEIGHT, 0))
        self.assertAlmostEqual(told['mean'], 0.5, delta=0.01)
        after = self.revision()
        self.assertEqual(told['revision'], after)
        self.assertNotEqual(after, before)
        self.assertEqual([mask['name'] for mask in self.daemon.layer(SMALL)['masks']], ['roads'])
        self.assertEqual([r['masks'] for r in self.daemon.layer(SMALL)['recipes'] if r['name'] == 'gsa'], [['roads']])
        self.assertEqual(self.daemon.layer(BIG)['masks'], [])
        masked = self.daemon.tile(SMALL, 'gsa', 4, 2, 2)
        self.assertNotEqual(masked.header('etag'), plain.header('etag'))
        self.assertNotEqual(masked.body, plain.body)
        old = self.daemon.get(f'/tiles/{SMALL}/gsa/4/2/2.f32?v={before}')
        self.assertEqual(old.status, 410)
        self.assertIn('immutable', self.daemon.tile(SMALL, 'gsa', 4, 2, 2, 'f32', f'v={after}').header('cache-control'))
        stored = self.daemon.admin('GET', f'/layers/{SMALL}/masks/roads')
        self.assertEqual((stored.status, stored.header('content-type')), (200, 'image/png'))
        width, height, channels, pixels = ld.read_png(stored.body)
        self.assertEqual((width, height, channels), (WIDTH, HEIGHT, 1))
        self.assertEqual(pixels, bytes(west_half(c, r) for r in range(HEIGHT) for c in range(WIDTH)))
        as_tif = self.daemon.admin('GET', f'/layers/{SMALL}/masks/roads?format=tif')
        self.assertEqual((as_tif.status, as_tif.header('content-type'), as_tif.body[:2]), (200, 'image/tiff', b'II'))
        self.assertEqual(self.daemon.admin('GET', f'/layers/{SMALL}/masks/roads?format=bmp').status, 400)
        # Kept over a kill: acknowledged is durable.
        self.daemon.restart(hard=True)
        self.assertEqual(self.revision(), after)
        self.assertEqual(self.daemon.tile(SMALL, 'gsa', 4, 2, 2).body, masked.body)
        gone = self.daemon.admin('DELETE', f'/layers/{SMALL}/masks/roads')
        self.assertEqual((gone.status, gone.body), (204, b''))
        self.assertEqual(self.revision(), before)
        self.assertEqual(self.daemon.tile(SMALL, 'gsa', 4, 2, 2).body, plain.body)
        self.assertEqual(self.daemon.admin('DELETE', f'/layers/{SMALL}/masks/roads').status, 404)
        self.assertEqual(self.daemon.admin('GET', f'/layers/{SMALL}/masks/roads').status, 404)
        self.assertEqual(self.daemon.complaints(), [])

    def test_white_is_linear_black_is_untouched_between_is_smooth(self):
        tiles = [(5, 12, 9), (5, 13, 9)]  # cells 192..208 and 208..224 of the data: the mask ends at 201
        recipes = ld.WAVELET_RECIPES
        bare = {(recipe, tile): self.grid(recipe, *tile) for recipe in recipes for tile in tiles}
        deep = {(recipe, tile): self.grid(recipe, *tile) for recipe in recipes for tile in ((8, 8 * 8, 8 * 9), (8, 8 * 20, 8 * 9))}
        self.put_well(ld.make_png(WIDTH, HEIGHT, west_half))
        for recipe in ('gsa', 'lsa'):
            for tile in tiles:
                masked = self.grid(recipe, *tile)
                smooth = []
                for column in range(65):
                    cell = tile[1] * 16 + column / 4  # data cells per column: 64 cells of a tile are 16 of the data
                    inside = masked.column(column).tobytes() == bare['linear', tile].column(column).tobytes()
                    outside = masked.column(column).tobytes() == bare[recipe, tile].column(column).tobytes()
                    if cell <= 201 - 2:
                        self.assertTrue(inside, f'{recipe} {tile} column {column}')
                    elif cell >= 201 + 2:
                        self.assertTrue(outside, f'{recipe} {tile} column {column}')
                    elif not inside and not outside:
                        smooth.append(cell)
                self.assertEqual(bool(smooth), tile == tiles[0])
            west, east = (8, 8 * 8, 8 * 9), (8, 8 * 20, 8 * 9)
            self.assertEqual(self.grid(recipe, *west).values.tobytes(), deep['linear', west].values.tobytes())
            self.assertEqual(self.grid(recipe, *east).values.tobytes(), deep[recipe, east].values.tobytes())
        self.assertEqual(self.grid('linear', *tiles[0]).values.tobytes(), bare['linear', tiles[0]].values.tobytes())
        here, east = self.grid('lsa', 7, 49, 36), self.grid('lsa', 7, 50, 36)
        self.assertEqual(here.column(64).tobytes(), east.column(0).tobytes())

    def test_base_and_coarser_levels_take_no_mask(self):
        before = {z: self.grid('lsa', z, 0, 0).values.tobytes() for z in (0, 2, 3)}
        self.put_well(ld.make_png(WIDTH, HEIGHT, lambda c, r: 255))
        self.assertEqual({z: self.grid('lsa', z, 0, 0).values.tobytes() for z in before}, before)

    def test_grey_removes_its_share_of_the_energy(self):
        def energy():
            gsa, linear = self.grid('gsa', 4, 6, 5), self.grid('linear', 4, 6, 5)
            return sum((a - b) ** 2 for a, b in zip(gsa.values, linear.values))
        bare = energy()
        for grey in (64, 128, 200):
            self.put_well(ld.make_png(WIDTH, HEIGHT, lambda c, r: grey))
            self.assertAlmostEqual(energy() / bare, 1 - grey / 255, delta=0.01)

    def test_png_geotiff_and_exr_are_the_same_mask(self):
        noise = random.Random(5)
        pixels = [noise.choice((0, 0, 128, 255)) for _ in range(WIDTH * HEIGHT)]
        png = ld.make_png(WIDTH, HEIGHT, lambda c, r: pixels[r * WIDTH + c])
        exr = ld.make_exr(WIDTH, HEIGHT, lambda c, r: pixels[r * WIDTH + c] / 255)
        png_path, tif_path = workspace.path('mask.png'), workspace.path('mask.tif')
        with open(png_path, 'wb') as file:
            file.write(png)
        west, south, east, north = self.daemon.layer(SMALL)['bounds']
        subprocess.run(['gdal_translate', '-q', '-of', 'GTiff', '-a_srs', 'EPSG:4326', '-a_ullr', *map(repr, (west, north, east, south)), png_path, tif_path],
                       check=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        with open(tif_path, 'rb') as file:
            tif = file.read()
        revisions, tiles = set(), set()
        for body, kind in ((png, 'image/png'), (tif, 'image/tiff'), (exr, 'image/x-exr')):
            told = self.put_well(body, kind=kind).json()
            self.assertEqual((told['width'], told['height'], told['level']), (WIDTH, HEIGHT, 0), kind)
            revisions.add(told['revision'])
            tiles.add(self.daemon.tile(SMALL, 'lsa', 6, 30, 20).body)
            self.assertEqual(ld.read_png(self.daemon.admin('GET', f'/layers/{SMALL}/masks/roads').body)[3], bytes(pixels), kind)
        self.assertEqual(len(tiles), 1)

    def test_several_masks_unite_and_recipes_choose(self):
        config = workspace.path('masks.toml')
        with open(config, 'w', encoding='utf-8') as file:
            file.write('[recipes.west]\nmethod = "gsa"\nmasks = ["west"]\n[recipes.none]\nmethod = "gsa"\nmasks = []\n')
        self.daemon.kill()
        self.daemon = ld.Daemon(workspace.data_dir(), '--device', 'host', config=config)
        self.addCleanup(self.daemon.kill)
        bare = {x: self.grid('gsa', 4, x, 5) for x in (2, 10)}
        flat = {x: self.grid('linear', 4, x, 5) for x in (2, 10)}
        self.put_well(ld.make_png(WIDTH, HEIGHT, west_half), name='west')
        self.put_well(ld.make_png(WIDTH, HEIGHT, lambda c, r: 255 - west_half(c, r)), name='east')
        for x in (2, 10):
            self.assertEqual(self.grid('gsa', 4, x, 5).values.tobytes(), flat[x].values.tobytes())
            self.assertEqual(self.grid('none', 4, x, 5).values.tobytes(), bare[x].values.tobytes())
        self.assertEqual(self.grid('west', 4, 2, 5).values.tobytes(), flat[2].values.tobytes())
        self.assertEqual(self.grid('west', 4, 10, 5).values.tobytes(), bare[10].values.tobytes())
        # A recipe without the changed mask keeps nothing stale and nothing wrong: same bytes under the new revision.
        self.daemon.admin('DELETE', f'/layers/{SMALL}/masks/east')
        self.assertEqual(self.grid('gsa', 4, 10, 5).values.tobytes(), bare[10].values.tobytes())

    def test_only_with_the_token_and_only_on_the_admin_listener(self):
        path = f'/layers/{SMALL}/masks/roads'
        png = ld.make_png(4, 4, lambda c, r: 255)
        revision = self.revision()
        for method, target, body in (('PUT', path, png), ('GET', path, None), ('DELETE', path, None), ('POST', '/purge', b''), ('POST', '/reload', b'')):
            for headers in ({}, {'Authorization': 'Bearer wrong'}, {'Authorization': f'Basic {ld.TOKEN}'}, {'Authorization': ld.TOKEN},
                            {'Authorization': f'Bearer {ld.TOKEN}x'}, {'Authorization': f'Bearer {ld.TOKEN[:-1]}'}, {'Authorization': 'Bearer '}):
                reply = self.daemon.request(method, target, headers, body, admin=True)
                self.assertEqual(reply.status, 401, f'{method} {target} {headers}')
                self.assertIn('Bearer', reply.header('www-authenticate'))
                self.assertNotIn(ld.TOKEN.encode(), reply.body)
            reply = self.daemon.request(method, target, {'Authorization': f'Bearer {ld.TOKEN}'}, body)
            self.assertEqual(reply.status, 404, f'{method} {target} on the public listener')
        self.assertEqual(self.revision(), revision)
        self.assertNotIn(ld.TOKEN, self.daemon.log())
        self.daemon.kill()
        closed = ld.Daemon(workspace.data_dir(), '--device', 'host', token=None)
        self.addCleanup(closed.kill)
        for headers in ({}, {'Authorization': 'Bearer '}, {'Authorization': 'Bearer None'}):
            reply = closed.request('POST', '/reload', headers, b'', admin=True)
            self.assertEqual(reply.status, 401)
            self.assertIn('LODESTONE_ADMIN_TOKEN', reply.json()['detail'])

    def check_refused(self, body, statuses, label, name='roads'):
        reply = self.put(body, name=name)
        self.assertIn(reply.status, statuses, f'{label}: {reply}')
        self.assertEqual(reply.header('content-type'), 'application/problem+json')
        self.assertGreater(len(reply.json()['detail']), 20, label)
        self.assertNotIn(b'root:', reply.body)

    def test_garbage_is_refused_and_changes_nothing(self):
        good = ld.make_png(WIDTH, HEIGHT, west_half)
        self.put_well(good)
        revision = self.revision()
        vrt = b'<VRTDataset rasterXSize="4" rasterYSize="4"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>' \
              b'<SourceFilename>/etc/passwd</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>'
        for label, body in (('nothing', b''), ('text', b'hello, mask'), ('a VRT', vrt), ('zeros', bytes(5000)), ('a script', b'#!/bin/sh\nid\n'),
                            ('SVG', b'<svg xmlns="http://www.w3.org/2000/svg"/>'), ('GIF', b'GIF89a\x01\x00\x01\x00\x00\x00\x00;'), ('EXR magic only', b'\x76\x2f\x31\x01\x02\0\0\0'),
                            ('TIFF magic only', b'II*\0\x08\0\0\0'), ('PNG magic only', good[:8])):
            self.check_refused(body, (400, 422), label)
        for at in (20, 40, 60, len(good) // 2, len(good) - 20):
            self.check_refused(good[:at], (422,), f'PNG cut at {at}')
        exr = ld.make_exr(20, 20, lambda c, r: 1)
        for at in (20, 100, len(exr) // 2, len(exr) - 3):
            self.check_refused(exr[:at], (422,), f'EXR cut at {at}')
        noise = random.Random(11)
        for _ in range(40):  # bit flips: an answer, whichever; and the daemon lives
            broken = bytearray(noise.choice((good, exr)))
            for _ in range(3):
                broken[noise.randrange(len(broken))] ^= 1 << noise.randrange(8)
            self.assertIn(self.put(bytes(broken), name='flipped').status, (200, 201, 413, 422))
        self.daemon.admin('DELETE', f'/layers/{SMALL}/masks/flipped')
        self.assertEqual(self.revision(), revision)
        self.assertEqual(self.daemon.get('/readyz').status, 200)
        for name in ('a%2fb', '..', '%2e%2e', 'a%00', 'x' * 300, 'a%20b%0a', '-', '%3Cscript%3E'):
            reply = self.put(good, name=name)
            self.assertIn(reply.status, (400, 404) if name != '-' else (201, 400), name)
        self.assertEqual(self.put(good, layer='nowhere').status, 404)

    def test_bombs_are_refused_before_they_are_unpacked(self):
        resident = self.daemon.metrics()['lodestone_resident_memory_bytes']
        line = b'\0' + bytes(40000)
        packer = zlib.compressobj(9)
        packed = b''.join(packer.compress(line) for _ in range(1000)) + packer.flush()
        bomb = ld.png_around(40000, 40000, packed)
        self.check_refused(bomb, (413, 422), 'PNG of 40000 x 40000')
        self.check_refused(ld.make_exr(4, 4, lambda c, r: 1, claimed=(60000, 60000)), (413, 422), 'EXR of 60000 x 60000')
        self.check_refused(ld.make_exr(4, 4, lambda c, r: 1, claimed=(2 ** 31 - 1, 2 ** 31 - 1)), (413, 422), 'EXR of 2^31 x 2^31')
        sparse = workspace.path('sparse.tif')
        subprocess.run(['gdal_create', '-q', '-of', 'GTiff', '-ot', 'Byte', '-outsize', '200000', '200000', '-co', 'SPARSE_OK=TRUE', '-co', 'TILED=YES',
                        '-co', 'BLOCKXSIZE=4096', '-co', 'BLOCKYSIZE=4096', sparse], check=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        with open(sparse, 'rb') as file:
            self.check_refused(file.read(), (413, 422), 'sparse TIFF of 200000 x 200000')
        with self.daemon.connect(admin=True) as sock:
            sock.sendall(f'PUT /layers/{SMALL}/masks/roads HTTP/1.1\r\nHost: a\r\nAuthorization: Bearer {ld.TOKEN}\r\nContent-Length: 999999999999\r\n\r\n'.encode())
            self.assertEqual(ld.parsed_response(sock, 'PUT').status, 413)
        self.assertLess(self.daemon.metrics()['lodestone_resident_memory_bytes'] - resident, 256e6)
        self.assertEqual(self.daemon.layer(SMALL)['masks'], [])

    def test_tiles_in_flight_while_masks_change_are_of_one_revision(self):
        bodies = {}
        for n in range(6):
            self.put_well(ld.make_png(WIDTH, HEIGHT, lambda c, r: 255 if n % 2 else 0))
            for _ in range(3):
                reply = self.daemon.tile(SMALL, 'gsa', 4, 6, 5)
                bodies.setdefault(reply.header('etag'), set()).add(reply.body)
        self.assertTrue(all(len(made) == 1 for made in bodies.values()))
        self.assertEqual(len({body for made in bodies.values() for body in made}), 2)


if __name__ == '__main__':
    unittest.main()
