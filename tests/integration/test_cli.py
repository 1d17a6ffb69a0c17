"""The command line: help, exit statuses (0 done, 1 failed, 2 wrong usage, 3 done with failures), configuration, and the same tiles as over HTTP."""

import json
import os
import re
import shutil
import subprocess
import tomllib
import unittest

import lodestone_daemon as ld
from lodestone_daemon import BIG, SMALL

HOST = ('--device', 'host')


def setUpModule():
    global workspace
    workspace = ld.Workspace()


def tearDownModule():
    workspace.remove()


class Usage(unittest.TestCase):
    def commands(self):
        text = ld.run('--help').stdout
        block = re.split(r'^(?:Subcommands|SUBCOMMANDS):\s*$', text, flags=re.M)[1]
        return re.findall(r'^  ([a-z]+)\b', block, flags=re.M)

    def test_help_of_every_command(self):
        commands = self.commands()
        for name in ('ingest', 'serve', 'tile', 'inspect', 'verify', 'purge', 'devices', 'config', 'evaluate'):
            self.assertIn(name, commands)
        for name in commands:
            with self.subTest(name):
                done = ld.run(name, '--help')
                self.assertEqual((done.returncode, done.stderr), (0, ''))
                self.assertIn('--data-dir', done.stdout)
                self.assertIn('--config', done.stdout)
                self.assertGreater(len(done.stdout.splitlines()), 6)

    def test_serve_help_tells_every_option(self):
        text = ld.run('serve', '--help').stdout
        for option in tomllib.loads(ld.run('config', 'dump').stdout):
            if option != 'recipes':
                self.assertIn('--' + option.replace('_', '-'), text)

    def test_version(self):
        done = ld.run('--version')
        self.assertEqual(done.returncode, 0)
        self.assertRegex(done.stdout, r'^lodestone \d+\.\d+\.\d+\n$')

    def test_wrong_usage_is_two(self):
        cases = [(), ('fly',), ('serve', '--fly'), ('tile',), ('tile', BIG), ('ingest',), ('ingest', ld.SAMPLE), ('config',), ('config', 'bake'),
                 ('evaluate',), ('verify', '--fast'), ('serve', '--workers', 'many'), ('serve', '--workers', '-1'), ('serve', '--workers', '9999'),
                 ('serve', '--log-level', 'loud'), ('serve', '--memory-cache-mib', '1.5'), ('inspect', '--workers')]
        for arguments in cases:
            with self.subTest(arguments=arguments):
                done = ld.run(*arguments, timeout=20)
                self.assertEqual(done.returncode, 2, done)
                self.assertEqual(done.stdout, '')
                self.assertTrue(done.stderr.startswith('lodestone: '), done.stderr)
                for argument in arguments[1:]:
                    if argument in ('many', 'bake', 'loud', '9999', '--fly', '--fast'):
                        self.assertIn(argument.lstrip('-'), done.stderr)

    def test_failures_are_one_and_name_the_object(self):
        data = ['--data-dir', workspace.template]
        cases = [(('ingest', '/nothing/here.tif', '--layer', 'a', '--data-dir', workspace.path('none')), '/nothing/here.tif'),
                 (('ingest', __file__, '--layer', 'a', '--data-dir', workspace.path('none')), os.path.basename(__file__)),
                 (('inspect', 'nowhere', *data), 'nowhere'), (('verify', 'nowhere', *data), 'nowhere'),
                 (('evaluate', 'nowhere', *data), 'nowhere'), (('evaluate', SMALL, '--recipes', 'nothing', *data), 'nothing'),
                 (('tile', 'nowhere', 'lsa', '0/0/0.f32', '-o', '-', *HOST, *data), 'nowhere'),
                 (('tile', BIG, 'lsa', '0/9/9.f32', '-o', '-', *HOST, *data), '0/9/9'),
                 (('tile', BIG, 'nothing', '0/0/0.f32', '-o', '-', *HOST, *data), 'nothing'),
                 (('tile', BIG, 'lsa', '0/0/0.f32', '-o', '/nothing/here.f32', *HOST, *data), '/nothing/here.f32'),
                 (('config', 'check', '--config', '/nothing/here.toml'), '/nothing/here.toml'),
                 (('tile', BIG, 'lsa', '0/0/0.f32', '-o', '-', '--device', 'abacus', *data), 'abacus')]
        for arguments, name in cases:
            with self.subTest(arguments=arguments):
                done = ld.run(*arguments)
                self.assertEqual(done.returncode, 1, done)
                self.assertIn(name, done.stderr)
        for address in ('0/0', '0/0/0', 'a/b/c.f32', '0/0/0.f32/1', '../0/0.f32'):
            done = ld.run('tile', BIG, 'lsa', address, '-o', '-', *HOST, *data)
            self.assertIn(done.returncode, (1, 2), done)
            self.assertGreater(len(done.stderr), 30)

    def test_bad_layer_names_are_refused(self):
        for name in ('../evil', 'a/b', '', '.', 'a b\n', 'x' * 300):
            done = ld.run('ingest', ld.SAMPLE, '--layer', name, '--data-dir', workspace.path('names'))
            self.assertIn(done.returncode, (1, 2), f'{name!r}: {done}')
        self.assertFalse(os.path.exists(workspace.path('evil')))
        self.assertEqual(json.loads(ld.run('inspect', '--json', '--data-dir', workspace.path('names')).stdout), [])


class Configuration(unittest.TestCase):
    def write(self, text):
        path = workspace.path('some.toml')
        with open(path, 'w', encoding='utf-8') as file:
            file.write(text)
        return path

    def dump(self, *flags, **more):
        done = ld.run('config', 'dump', *flags, **more)
        self.assertEqual(done.returncode, 0, done)
        return tomllib.loads(done.stdout)

    def test_the_shipped_file_is_the_dump_of_the_defaults(self):
        with open(os.path.join(ld.SOURCE_DIR, 'config', 'lodestone.toml'), encoding='utf-8') as file:
            shipped = file.read()
        self.assertEqual(ld.run('config', 'dump', '--comments').stdout, shipped)
        self.assertEqual(self.dump('--config', os.path.join(ld.SOURCE_DIR, 'config', 'lodestone.toml')), self.dump())

    def test_a_dump_reads_back(self):
        path = self.write('workers = 3\nlisten = "[::1]:99"\n[recipes.hills]\nmethod = "lsa"\nseed = 42\nwindow = 5\nmasks = ["roads", "rivers"]\n'
                          'mask_mode = "protect"\nquantum = 0.25\n[recipes.gsa]\nfit = "paper"\n')
        told = self.dump('--config', path)
        self.assertEqual((told['workers'], told['listen'], told['recipes']['gsa']['fit']), (3, '[::1]:99', 'paper'))
        hills = told['recipes']['hills']
        self.assertEqual((hills['method'], hills['seed'], hills['window'], hills['masks'], hills['mask_mode'], hills['quantum']),
                         ('lsa', 42, 5, ['roads', 'rivers'], 'protect', 0.25))
        again = self.write(ld.run('config', 'dump', '--config', path).stdout)
        self.assertEqual(self.dump('--config', again), told)

    def test_precedence_flags_environment_file_defaults(self):
        path = self.write('workers = 3\nqueue_tiles = 30\nbatch_tiles = 5\n')
        env = {'LODESTONE_WORKERS': '4', 'LODESTONE_QUEUE_TILES': '40', 'LODESTONE_CONFIG': path}
        told = self.dump('--workers', '5', env=env)
        self.assertEqual((told['workers'], told['queue_tiles'], told['batch_tiles'], told['local_size']), (5, 40, 5, 64))
        told = self.dump('--config', path)
        self.assertEqual((told['workers'], told['queue_tiles']), (3, 30))

    def test_the_token_is_never_printed(self):
        done = ld.run('config', 'dump', env={'LODESTONE_ADMIN_TOKEN': 'open-sesame'})
        self.assertEqual(done.returncode, 0)
        self.assertNotIn('open-sesame', done.stdout + done.stderr)

    def test_check_names_place_rule_and_fix(self):
        good = ld.run('config', 'check', '--config', self.write('workers = 1\n'))
        self.assertEqual(good.returncode, 0, good)
        cases = [('workers = 1\nquee_tiles = 3\n', r'some\.toml:2:\d+: .*quee_tiles.*did you mean queue_tiles'),
                 ('workers = "many"\n', r'some\.toml:1:\d+: .*workers.*many.*0\.\.256'),
                 ('\n\nworkers = 1000\n', r'some\.toml:3:\d+: .*1000.*0\.\.256'),
                 ('workers = [1]\n', r'some\.toml:1:\d+: .*workers'), ('workers = \n', r'some\.toml:1:\d+: '),
                 ('[workers]\na = 1\n', r'some\.toml:1:\d+: .*workers'), ('workers = 1\nworkers = 2\n', r'some\.toml:2:\d+: '),
                 ('[recipes.a]\nmethod = "lsaa"\n', r'some\.toml:2:\d+: .*lsaa.*gsa, lsa'), ('[recipes.a]\nwindw = 3\n', r'some\.toml:2:\d+: .*windw.*did you mean window'),
                 ('[recipes.a]\nwindow = 4\n', r'some\.toml:2:\d+: .*window.*4'), ('[recipes.a]\nseed = -1\n', r'some\.toml:2:\d+: .*seed.*-1'),
                 ('[recipes.a]\nmasks = "roads"\n', r'some\.toml:2:\d+: .*masks.*list'), ('[recipes."../x"]\nseed = 1\n', r'some\.toml:1:\d+: .*recipe'),
                 ('[recipes.a]\nquantum = 0.3\n', r'some\.toml:2:\d+: .*quantum.*power of two'), ('recipes = 3\n', r'some\.toml:1:\d+: .*recipes'),
                 ('[recipes.a]\naltitude = [1, 2]\n', r'some\.toml:2:\d+: .*altitude.*four')]
        for text, wanted in cases:
            with self.subTest(text):
                done = ld.run('config', 'check', '--config', self.write(text))
                self.assertEqual(done.returncode, 1, done)
                self.assertRegex(done.stderr, wanted)

    def test_environment_is_checked_too(self):
        for env, wanted in (({'LODESTONE_WORKRS': '1'}, 'LODESTONE_WORKRS.*did you mean workers'), ({'LODESTONE_WORKERS': 'x'}, 'LODESTONE_WORKERS.*workers')):
            done = ld.run('config', 'check', env=env)
            self.assertEqual(done.returncode, 1, done)
            self.assertRegex(done.stderr, wanted)
        unreadable = ld.run('serve', '--config', workspace.path('some-other.toml'))
        self.assertIn(unreadable.returncode, (1, 2))
        self.assertIn('some-other.toml', unreadable.stderr)


class Work(unittest.TestCase):
    def test_tile_writes_the_bytes_that_the_daemon_serves(self):
        data_dir = workspace.data_dir()
        requests = [(BIG, 'lsa', '3/2/2', 'exr', ''), (BIG, 'gsa', '5/9/7', 'f32', 'seed=18446744073709551615'), (SMALL, 'linear', '2/1/1', 'tif', ''),
                    (BIG, 'lsa', '4/3/3', 'png', 'encoding=mapbox&size=257'), (BIG, 'lsa', '3/2/2', 'exr', 'compression=zip&channels=Y,provenance')]
        with ld.Daemon(data_dir) as daemon:
            for number, (layer, recipe, address, ext, query) in enumerate(requests):
                path = workspace.path(f'{number}.{ext}')
                done = ld.run('tile', layer, recipe, f'{address}.{ext}', '-o', path, '--data-dir', data_dir, *(HOST if number % 2 else ()),
                              *(['--query', query] if query else []))
                self.assertEqual(done.returncode, 0, done)
                with open(path, 'rb') as file:
                    written = file.read()
                self.assertTrue(written == daemon.tile(layer, recipe, *address.split('/'), ext, query).body, (layer, recipe, address, ext, query))
                self.assertIn(str(len(written)), done.stdout)
                self.assertFalse(os.path.exists(path + '.tmp'))
        piped = ld.run('tile', BIG, 'lsa', '3/2/2.f32', '-o', '-', '--data-dir', data_dir, *HOST, text=False)
        self.assertEqual((piped.returncode, len(piped.stdout)), (0, 257 * 257 * 4))
        wrong = ld.run('tile', BIG, 'lsa', '3/2/2.f32', '-o', '-', '--query', 'colour=red', '--data-dir', data_dir, *HOST)
        self.assertEqual(wrong.returncode, 2)
        self.assertIn('colour', wrong.stderr)

    def test_ingest_again_makes_a_new_revision_only_when_something_changed(self):
        data_dir = workspace.data_dir()
        def revision():
            return json.loads(ld.run('inspect', SMALL, '--json', '--data-dir', data_dir).stdout)[0]['revision']
        first = revision()
        self.assertEqual(ld.run('ingest', ld.SAMPLE, '--layer', SMALL, '--posts-per-tile', '65', '--datum', 'EGM96', '--data-dir', data_dir).returncode, 0)
        self.assertEqual(revision(), first)
        self.assertEqual(ld.run('ingest', ld.SAMPLE, '--layer', SMALL, '--posts-per-tile', '129', '--datum', 'EGM96', '--data-dir', data_dir).returncode, 0)
        self.assertNotEqual(revision(), first)

    def test_ingest_on_other_grids(self):
        data_dir = workspace.path('grids')
        for grid, crs in (('WorldCRS84Quad', ('OGC:CRS84', 'EPSG:4326')), ('WebMercatorQuad', ('EPSG:3857',))):
            done = ld.run('ingest', ld.SAMPLE, '--layer', grid, '--grid', grid, '--data-dir', data_dir, '--json')
            self.assertEqual(done.returncode, 0, done)
            told = json.loads(done.stdout)
            self.assertEqual(told['grid'], grid)
            self.assertIn(told['crs_name'], crs)
            west, south, east, north = told['bounds_wgs84']
            self.assertTrue(west <= -84.413 and east >= -84.079 and south <= 36.447 and north >= 36.732, told['bounds_wgs84'])
            self.assertLess(east - west, 1.5)
        with ld.Daemon(data_dir, *HOST) as daemon:
            mercator, geodetic = daemon.layer('WebMercatorQuad'), daemon.layer('WorldCRS84Quad')
            for layer, lon, lat in ((mercator, -84.25, 36.6), (geodetic, -84.25, 36.6)):
                told = daemon.get(f'/heights/{layer["name"]}/linear?lon={lon}&lat={lat}').json()
                self.assertEqual(told['provenance'], 'surveyed')
                native = ld.sample_heights()
                column, row = (lon + 84.41375) * 1200 - 0.5, (36.732916667 - lat) * 1200 - 0.5
                near = [native.at(int(column) + dx, int(row) + dy) for dx in (0, 1) for dy in (0, 1)]
                self.assertGreater(told['height_m'], min(near) - 30)
                self.assertLess(told['height_m'], max(near) + 30)
                # The tile's address is that of the standard grid: x counts from 180 degrees west.
                z, x, _ = map(int, told['tile'].split('/'))
                columns = 2 ** z if layer is mercator else 2 ** (z + 1)
                self.assertEqual(x, int((lon + 180) / 360 * columns))
        refused = ld.run('ingest', ld.SAMPLE, '--layer', 'x', '--grid', 'Mars2000Quad', '--data-dir', data_dir)
        self.assertEqual(refused.returncode, 2)
        self.assertIn('Mars2000Quad', refused.stderr)

    def test_inspect(self):
        told = json.loads(ld.run('inspect', '--json', '--data-dir', workspace.template).stdout)
        self.assertEqual([layer['name'] for layer in told], sorted([BIG, SMALL]))
        for layer in told:
            self.assertRegex(layer['revision'], '^[0-9a-f]{16}$')
            self.assertEqual(len(layer['roughness']), 3)
            for fit in layer['roughness']:
                self.assertAlmostEqual(fit['hurst'], fit['gamma'] / 2)
                self.assertTrue(0.2 <= fit['gamma'] <= 4)
        with ld.Daemon(workspace.data_dir(), *HOST) as daemon:
            self.assertEqual({layer['name']: layer['revision'] for layer in told}, {name: daemon.layer(name)['revision'] for name in (BIG, SMALL)})
        text = ld.run('inspect', BIG, '--data-dir', workspace.template).stdout
        for part in (BIG, 'EPSG:4326', '403 x 344', 'EGM96', 'base level 1'):
            self.assertIn(part, text)
        empty = ld.run('inspect', '--data-dir', workspace.path('nothing-there'))
        self.assertEqual(empty.returncode, 0)
        self.assertIn('no layers', empty.stdout)

    def test_verify_finds_a_flipped_bit_and_says_three(self):
        data_dir = workspace.data_dir()
        good = ld.run('verify', '--json', '--data-dir', data_dir)
        self.assertEqual(good.returncode, 0, good)
        told = json.loads(good.stdout)['layers']
        self.assertEqual({name: layer['problems'] for name, layer in told.items()}, {BIG: [], SMALL: []})
        self.assertGreater(told[SMALL]['values'], 42)
        folder = os.path.join(data_dir, 'layers', SMALL)
        with open(os.path.join(folder, 'CURRENT'), encoding='utf-8') as file:
            path = os.path.join(folder, file.read().strip(), 'data.mdb')
        size = os.path.getsize(path)
        broken = 0
        for at in range(size // 3, size, size // 7):
            with open(path, 'r+b') as file:
                file.seek(at)
                byte = file.read(1)
                file.seek(at)
                file.write(bytes([byte[0] ^ 16]))
            done = ld.run('verify', SMALL, '--json', '--data-dir', data_dir)
            self.assertIn(done.returncode, (0, 1, 3), done)
            if done.returncode == 3:
                broken += 1
                self.assertGreater(len(json.loads(done.stdout)['layers'][SMALL]['problems']), 0)
        self.assertGreater(broken, 0)

    def test_purge(self):
        data_dir = workspace.data_dir()
        with ld.Daemon(data_dir, *HOST) as daemon:
            for z in (2, 3, 4):
                daemon.tile(SMALL, 'lsa', z, 1, 1)
            daemon.tile(BIG, 'lsa', 2, 1, 1)
            busy = ld.run('purge', '--data-dir', data_dir)
            self.assertEqual(busy.returncode, 1)
            self.assertIn('/purge', busy.stderr)
            daemon.stop()
        for arguments, removed in (((SMALL, 'gsa'), 0), ((SMALL, 'lsa'), 3), ((), 1), ((), 0)):
            done = ld.run('purge', *arguments, '--data-dir', data_dir)
            self.assertEqual((done.returncode, int(re.search(r'\d+', done.stdout)[0])), (0, removed), arguments)

    def test_devices(self):
        told = json.loads(ld.run('devices', '--json').stdout)
        self.assertGreater(len(told), 0)
        self.assertGreater(told[0]['compute_units'], 0)
        self.assertIn(told[0]['name'], ld.run('devices').stdout)

    def test_evaluate_measures_the_held_out_levels(self):
        pictures = workspace.path('pictures')
        done = ld.run('evaluate', BIG, '--levels', '1', '--json', '-o', pictures, '--data-dir', workspace.template, *HOST)
        self.assertEqual(done.returncode, 0, done)
        told = {row['recipe']: row for row in json.loads(done.stdout)}
        self.assertEqual(set(told), {'linear', 'gsa', 'lsa'})
        self.assertGreater(told['lsa']['rough_corr'], 0.4)
        self.assertLess(abs(told['gsa']['rough_corr']), 0.3)
        self.assertLess(told['lsa']['band_rms'], 2)
        width, height, _, pixels = self.picture(pictures)
        self.assertEqual((width, height), (512, 512))
        self.assertGreater(len(set(pixels)), 50)
        text = ld.run('evaluate', SMALL, '--levels', '1', '--recipes', 'lsa', '--data-dir', workspace.template, *HOST).stdout
        self.assertRegex(text, r'(?m)^lsa +1 ')
        wrong = ld.run('evaluate', BIG, '--levels', '9', '--data-dir', workspace.template, *HOST)
        self.assertEqual(wrong.returncode, 2)
        self.assertIn('--levels 9', wrong.stderr)

    @staticmethod
    def picture(folder):
        with open(os.path.join(folder, f'{BIG}-1.png'), 'rb') as file:
            return ld.read_png(file.read())

    def test_the_program_runs_without_its_source_tree_or_a_home(self):
        copy = workspace.path('elsewhere')
        os.makedirs(copy)
        shutil.copy(ld.program(), copy)
        for arguments, wanted in ((('config', 'check'), 0), (('inspect', '--data-dir', workspace.template), 0)):
            done = subprocess.run([os.path.join(copy, os.path.basename(ld.program())), *arguments], cwd=copy, env={'PATH': os.environ['PATH']},
                                     stdout=subprocess.PIPE, stderr=subprocess.PIPE, check=False)
            self.assertEqual(done.returncode, wanted, done)


if __name__ == '__main__':
    unittest.main()
