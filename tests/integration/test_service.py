"""The daemon as a service: its documents, metrics, life cycle, and how it behaves when many ask at once."""

import concurrent.futures
import gzip
import json
import os
import re
import signal
import socket
import struct
import time
import unittest

import lodestone_daemon as ld
from lodestone_daemon import BIG, SMALL, Grid

# Where the device plays no part: starts at once, without building kernels.
ON_HOST = ('--device', 'host')


def setUpModule():
    global workspace
    workspace = ld.Workspace()


def tearDownModule():
    workspace.remove()


def wait_until(check, what, limit_s=10):
    deadline = time.monotonic() + limit_s
    while not check():
        if time.monotonic() > deadline:
            raise AssertionError(f'not within {limit_s} s: {what}')
        time.sleep(0.02)


def same_time(count, call):
    """call(n) for n in range(count), each on a thread of its own; results in order."""
    with concurrent.futures.ThreadPoolExecutor(count) as pool:
        return list(pool.map(call, range(count)))


class Documents(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.daemon = ld.Daemon(workspace.data_dir(), '--cors-origins', '*')
        cls.addClassCleanup(cls.daemon.kill)

    def test_landing_page_in_two_forms(self):
        page = self.daemon.get('/', {'Accept': 'text/html,application/xhtml+xml,*/*;q=0.8'})
        self.assertEqual(page.status, 200)
        self.assertTrue(page.header('content-type').startswith('text/html'))
        self.assertIn('default-src', page.header('content-security-policy'))
        self.assertIn('Accept', page.header('vary'))
        links = set(re.findall(r'(?:href|src)="([^"]+)"', page.body.decode()))
        self.assertGreaterEqual(len(links), 6)
        for link in links:
            self.assertTrue(link.startswith('/'), f'{link} leaves the daemon')
            self.assertEqual(self.daemon.get(link.replace('&amp;', '&')).status, 200, link)
        for headers in ({}, {'Accept': 'application/json'}, {'Accept': '*/*'}):
            told = self.daemon.get('/', headers).json()
            self.assertEqual({layer['name'] for layer in told['layers']}, {BIG, SMALL})
            host = 'http://{}:{}'.format(*self.daemon.address)
            for link in [layer['href'] for layer in told['layers']] + [link['href'] for link in told['links']]:
                self.assertTrue(link.startswith(host + '/'), link)
                self.assertEqual(self.daemon.get(link[len(host):]).status, 200, link)

    def test_health_and_readiness(self):
        self.assertEqual(self.daemon.get('/healthz').json()['status'], 'alive')
        ready = self.daemon.get('/readyz')
        self.assertEqual((ready.status, ready.json()['status'], ready.json()['layers']), (200, 'ready', 2))
        self.assertEqual(self.daemon.request('GET', '/healthz', admin=True).status, 200)

    def test_metrics_are_well_formed_and_never_fall(self):
        def read():
            reply = self.daemon.get('/metrics')
            self.assertTrue(reply.header('content-type').startswith('text/plain; version=0.0.4'))
            return reply.body.decode()
        before = read()
        kinds, helped, seen = {}, set(), set()
        for line in before.splitlines():
            if line.startswith('# HELP '):
                _, _, name, meaning = line.split(' ', 3)
                self.assertNotIn(name, helped)
                self.assertTrue(meaning.endswith('.') or ';' in meaning or len(meaning) > 5, line)
                helped.add(name)
            elif line.startswith('# TYPE '):
                _, _, name, kind = line.split(' ')
                self.assertIn(kind, ('counter', 'gauge', 'histogram', 'summary'))
                self.assertNotIn(name, kinds)
                kinds[name] = kind
            else:
                sample = re.fullmatch(r'(lodestone_[a-z0-9_]+)(\{[a-z_]+="[^"]*"(?:,[a-z_]+="[^"]*")*\})? (\S+)', line)
                self.assertIsNotNone(sample, line)
                name, labels, value = sample.groups()
                self.assertIn(name, kinds, f'{name} has no TYPE before it')
                self.assertIn(name, helped)
                self.assertNotIn((name, labels), seen)
                seen.add((name, labels))
                self.assertEqual(kinds[name] == 'counter', name.endswith('_total'), name)
                self.assertGreaterEqual(float(value), 0)
                self.assertNotRegex(labels or '', r'[{,](x|y|z|seed)=')
        for n in range(5):
            self.daemon.get(f'/tiles/{SMALL}/gsa/6/{n}/1.f32')
            self.daemon.get(f'/tiles/{SMALL}/gsa/6/{n}/1.f32')
        self.daemon.get('/nothing')
        old, new = ld.metric_values(before), ld.metric_values(read())
        self.assertEqual(set(old), set(new))
        for name in old:
            if kinds[name.split('{')[0]] == 'counter':
                self.assertGreaterEqual(new[name], old[name], name)
        grown = {name: new[name] - old[name] for name in old}
        self.assertEqual(grown['lodestone_tiles_generated_total'], 5)
        self.assertEqual(grown['lodestone_cache_hits_total{tier="memory"}'], 5)
        self.assertEqual(grown['lodestone_cache_misses_total{tier="memory"}'], 5)
        self.assertEqual(grown['lodestone_http_requests_total{class="4xx"}'], 1)
        self.assertGreater(new['lodestone_resident_memory_bytes'], 1e6)

    def test_layer_description(self):
        description = self.daemon.layer(BIG)
        for name in ('name crs grid bounds bounds_wgs84 posts_per_tile width_posts height_posts base_level max_level spacing height_min_m height_max_m '
                     'datum revision recipes masks zones imagery tiles').split():
            self.assertIn(name, description)
        self.assertEqual([description[n] for n in ('name', 'crs', 'grid', 'posts_per_tile', 'width_posts', 'height_posts', 'base_level', 'max_level', 'datum')],
                         [BIG, 'EPSG:4326', 'native', 257, 403, 344, 1, 17, 'EGM96'])
        source = ld.sample_heights()
        self.assertEqual((description['height_min_m'], description['height_max_m']), (min(source.values), max(source.values)))
        west, south, east, north = description['bounds']
        step = 1 / 1200
        self.assertAlmostEqual(east - west, 402 * step, places=9)
        self.assertAlmostEqual(north - south, 343 * step, places=9)
        self.assertAlmostEqual(west, -84.41375 + step / 2, places=9)
        for got, wanted in zip(description['bounds_wgs84'], description['bounds']):
            self.assertAlmostEqual(got, wanted, places=9)
        self.assertEqual(len(description['spacing']), 18)
        for z, (x, y) in enumerate(description['spacing']):
            self.assertAlmostEqual(x * 2 ** z, description['spacing'][0][0], places=12)
            self.assertAlmostEqual(y, x, places=12)
        self.assertEqual({r['name'] for r in description['recipes']},
                         {'linear', 'gsa', 'lsa', 'square-square', 'diamond-square', 'fractal-wavelet'})
        everything = self.daemon.get('/layers').json()['layers']
        self.assertEqual([layer['name'] for layer in everything], sorted([BIG, SMALL]))
        self.assertIn(description, everything)
        url = description['tiles'].replace('{recipe}', 'lsa').replace('{z}', '2').replace('{x}', '1').replace('{y}', '1').replace('{ext}', 'f32')
        reply = self.daemon.get(url[len('http://{}:{}'.format(*self.daemon.address)):])
        self.assertEqual(reply.status, 200)
        self.assertIn('immutable', reply.header('cache-control'))

    def test_exactly_the_tiles_of_the_bounds_are_there(self):
        for z in (0, 2, 3, 5):
            cells = 64 if z <= 3 else 64
            last_x = -(-402 * 2 ** z // (8 * cells)) - 1 if z < 3 else ((402 << (z - 3)) - 1) // 64
            last_y = -(-343 * 2 ** z // (8 * cells)) - 1 if z < 3 else ((343 << (z - 3)) - 1) // 64
            self.assertEqual(self.daemon.get(f'/tiles/{SMALL}/lsa/{z}/{last_x}/{last_y}.f32').status, 200)
            self.assertEqual(self.daemon.get(f'/tiles/{SMALL}/lsa/{z}/{last_x + 1}/{last_y}.f32').status, 404)
            self.assertEqual(self.daemon.get(f'/tiles/{SMALL}/lsa/{z}/{last_x}/{last_y + 1}.f32').status, 404)

    def test_tilejson(self):
        for encoding in ('terrarium', 'mapbox'):
            told = self.daemon.get(f'/tiles/{BIG}/lsa/tilejson.json?encoding={encoding}&seed=5').json()
            self.assertEqual((told['tilejson'], told['scheme'], told['encoding'], told['tileSize'], told['minzoom']), ('3.0.0', 'xyz', encoding, 256, 0))
            self.assertLessEqual(told['maxzoom'], 30)
            self.assertEqual(told['bounds'], self.daemon.layer()['bounds_wgs84'])
            self.assertTrue(told['bounds'][0] <= told['center'][0] <= told['bounds'][2])
            url = told['tiles'][0].replace('{z}', '3').replace('{x}', '2').replace('{y}', '2')
            png = self.daemon.get(url[len('http://{}:{}'.format(*self.daemon.address)):])
            self.assertEqual((png.status, ld.read_png(png.body)[:2]), (200, (256, 256)))
            self.assertEqual(png.body, self.daemon.tile(BIG, 'lsa', 3, 2, 2, 'png', f'encoding={encoding}&seed=5').body)

    def test_gzip_is_negotiated(self):
        plain = self.daemon.get('/layers')
        self.assertIsNone(plain.header('content-encoding'))
        self.assertIn('Accept-Encoding', plain.header('vary'))
        for accept in ('gzip', 'gzip, deflate, br', 'br;q=1, gzip;q=0.5', '*', 'x-gzip'):
            coded = self.daemon.get('/layers', {'Accept-Encoding': accept})
            self.assertEqual(coded.header('content-encoding'), 'gzip', accept)
            self.assertEqual(gzip.decompress(coded.body), plain.body)
            self.assertLess(len(coded.body), len(plain.body) / 2)
            self.assertIn('Accept-Encoding', coded.header('vary'))
        for accept in ('', 'br', 'identity', 'gzip;q=0', 'gzip;q=0, *', 'zstd, br'):
            self.assertIsNone(self.daemon.get('/layers', {'Accept-Encoding': accept}).header('content-encoding'), accept)
        self.assertIsNone(self.daemon.get('/healthz', {'Accept-Encoding': 'gzip'}).header('content-encoding'), 'a body too small to pay')
        self.assertIsNone(self.daemon.get(f'/tiles/{BIG}/lsa/3/2/2.exr', {'Accept-Encoding': 'gzip'}).header('content-encoding'))

    def test_cors(self):
        path = f'/tiles/{BIG}/lsa/3/2/2.exr'
        reply = self.daemon.get(path, {'Origin': 'https://maps.example'})
        self.assertEqual(reply.header('access-control-allow-origin'), '*')
        self.assertIn('ETag', reply.header('access-control-expose-headers'))
        ask = {'Origin': 'https://maps.example', 'Access-Control-Request-Method': 'GET', 'Access-Control-Request-Headers': 'if-none-match'}
        preflight = self.daemon.request('OPTIONS', path, ask)
        self.assertEqual((preflight.status, preflight.body), (204, b''))
        self.assertEqual(preflight.header('access-control-allow-origin'), '*')
        self.assertIn('GET', preflight.header('access-control-allow-methods'))
        self.assertIn('if-none-match', preflight.header('access-control-allow-headers').lower())
        with ld.Daemon(workspace.data_dir(), *ON_HOST, '--cors-origins', 'https://a.example, https://b.example') as strict:
            for origin, allowed in (('https://a.example', True), ('https://b.example', True), ('https://evil.example', False), ('null', False)):
                for method in ('GET', 'OPTIONS'):
                    reply = strict.request(method, '/layers', {**ask, 'Origin': origin})
                    self.assertEqual(reply.header('access-control-allow-origin'), origin if allowed else None, f'{method} {origin}')
                    self.assertIn('Origin', reply.header('vary', ''), f'{method} {origin}')

    def test_openapi_tells_what_is_answered(self):
        document = self.daemon.get('/openapi.json').json()
        self.assertTrue(document['openapi'].startswith('3.1'))
        values = {'layer': BIG, 'recipe': 'lsa', 'z': '3', 'x': '2', 'y': '2', 'ext': 'exr', 'name': 'roads', 'id': '1', 'tileMatrixSetId': 'WebMercatorQuad',
                  'collectionId': BIG, 'tileMatrix': '3', 'tileRow': '2', 'tileCol': '2', 'level': '0'}
        queries = {'/heights/{layer}/{recipe}': '?lon=-84.3&lat=36.6'}
        bodies = {'/heights/{layer}/{recipe}': b'{"points": [[-84.3, 36.6]]}'}
        answered = 0
        for path, methods in document['paths'].items():
            address = re.sub(r'\{(\w+)\}', lambda m: values[m[1]], path)
            for method, operation in methods.items():
                if method not in ('get', 'put', 'post', 'delete', 'patch', 'head', 'options'):
                    continue
                documented = set(operation['responses'])
                is_admin = bool(operation.get('security'))
                body = None if method not in ('post', 'put') else bodies.get(path, b'{}') if 'requestBody' in operation else b''
                for headers in ([{'Authorization': f'Bearer {ld.TOKEN}'}, {}] if is_admin else [{}]):
                    for query in (queries.get(path, '') if method == 'get' else '', '?no-such-key=1'):
                        reply = self.daemon.request(method.upper(), address + query, headers, body, admin=is_admin)
                        label = f'{method} {address}{query} {headers}: {reply}'
                        self.assertNotIn(reply.status, (405, 501, 500), label)
                        if reply.status == 404:
                            self.assertIn('roads', reply.json()['detail'], label)
                        self.assertIn(str(reply.status), documented, label)
                        if is_admin and not headers:
                            self.assertEqual(reply.status, 401, label)
                        answered += 1
                    allow = self.daemon.request('OPTIONS', address, admin=is_admin).header('allow') or \
                        self.daemon.request('PATCH', address, admin=is_admin).header('allow', '')
                    self.assertIn(method.upper(), allow, label)
        self.assertGreater(answered, 25)
        for path in ('/', '/healthz', '/readyz', '/metrics', '/openapi.json', '/layers', '/tiles/{layer}/{recipe}/{z}/{x}/{y}.{ext}',
                     '/heights/{layer}/{recipe}', '/layers/{layer}/masks/{name}', '/purge', '/reload'):
            self.assertIn(path, document['paths'])

    def test_heights_are_the_posts_of_the_tile(self):
        description = self.daemon.layer(SMALL)
        t, base = description['transform'], description['base_level']
        points = [(-84.3, 36.6), (-84.2501, 36.5003), (-84.41, 36.73), (-84.0785, 36.4470), tuple(description['bounds'][0:2]), tuple(description['bounds'][2:4]),
                  (t[0] + 17 * t[1], t[3] + 33 * t[5]), (t[0] + 64 * t[1], t[3] + 64 * t[5])]
        for recipe, z in (('linear', 2), ('lsa', 3), ('lsa', 6), ('gsa', 14)):
            last = {axis: (count - 1) << (z - base) if z >= base else None for axis, count in (('x', 403), ('y', 344))}
            wanted = []
            for lon, lat in points:
                column, row = (lon - t[0]) / t[1] * 2.0 ** (z - base), (lat - t[3]) / t[5] * 2.0 ** (z - base)
                if last['x'] is not None:
                    column, row = min(max(column, 0), last['x']), min(max(row, 0), last['y'])
                i, j = int(column), int(row)
                if last['x'] is not None:
                    i, j = min(i, last['x'] - 1), min(j, last['y'] - 1)
                i, j = max(i, 0), max(j, 0)
                tile = Grid.square(self.daemon.tile(SMALL, recipe, z, i // 64, j // 64).f32())
                fx, fy = column - i, row - j
                i, j = i % 64, j % 64
                wanted.append((tile.at(i, j) * (1 - fx) + tile.at(i + 1, j) * fx) * (1 - fy) +
                              (tile.at(i, j + 1) * (1 - fx) + tile.at(i + 1, j + 1) * fx) * fy)
            many = self.daemon.request('POST', f'/heights/{SMALL}/{recipe}', None, json.dumps({'points': points, 'z': z}).encode())
            self.assertEqual(many.status, 200, many)
            told = many.json()
            self.assertEqual((told['layer'], told['recipe'], told['z'], told['revision'], told['datum']), (SMALL, recipe, z, description['revision'], 'EGM96'))
            for (lon, lat), height, answer in zip(points, wanted, told['points']):
                one = self.daemon.get(f'/heights/{SMALL}/{recipe}?lon={lon!r}&lat={lat!r}&z={z}').json()
                self.assertEqual((one['height_m'], one['provenance']), (answer['height_m'], answer['provenance']))
                self.assertAlmostEqual(one['height_m'], height, delta=0.02 if z > 10 else 2e-3, msg=f'{recipe} {z} {lon} {lat}')
                self.assertIn(one['provenance'], ('synthetic',) if z > base else ('surveyed',) if z == base else ('surveyed', 'filled'))
        outside = self.daemon.request('POST', f'/heights/{SMALL}/lsa', None, b'{"points": [[0, 0], [-84.3, 36.6]]}').json()['points']
        self.assertEqual((outside[0]['height_m'], outside[0]['provenance']), (None, 'outside'))
        self.assertGreater(outside[1]['height_m'], 200)
        self.assertEqual(self.daemon.request('POST', f'/heights/{SMALL}/lsa', None, b'{"points": []}').json()['points'], [])
        seeds = [self.daemon.get(f'/heights/{SMALL}/gsa?lon=-84.3&lat=36.6&z=6&seed={s}').json()['height_m'] for s in (1, 2 ** 64 - 1)]
        self.assertNotEqual(*seeds)
        posted = self.daemon.request('POST', f'/heights/{SMALL}/gsa', None, json.dumps({'points': [[-84.3, 36.6]], 'z': 6, 'seed': 2 ** 64 - 1}).encode())
        self.assertEqual(posted.json()['points'][0]['height_m'], seeds[1])
        self.assertEqual(posted.json()['seed'], 2 ** 64 - 1)


class Crowds(unittest.TestCase):
    def test_a_crowd_on_one_cold_tile_costs_one_computation(self):
        with ld.Daemon(workspace.data_dir()) as daemon:
            daemon.get('/readyz')
            replies = same_time(100, lambda _: daemon.get(f'/tiles/{BIG}/lsa/9/100/77.exr?compression=zip'))
            self.assertEqual({reply.status for reply in replies}, {200})
            self.assertEqual(len({reply.body for reply in replies}), 1)
            self.assertEqual(len({reply.header('etag') for reply in replies}), 1)
            metrics = daemon.metrics()
            self.assertEqual(metrics['lodestone_tiles_generated_total'], 1)
            self.assertEqual(daemon.complaints(), [])

    def test_a_full_queue_is_told_and_passes(self):
        with ld.Daemon(workspace.data_dir(), '--queue-tiles', '1', '--workers', '1', '--batch-tiles', '1', '--disk-cache-mib', '0') as daemon:
            daemon.get('/readyz')
            warm = f'/tiles/{BIG}/lsa/4/0/0.f32'
            self.assertEqual(daemon.get(warm).status, 200)
            path = '/tiles/{}/lsa/17/{}/0.exr?compression=piz'.format
            replies = same_time(60, lambda n: daemon.get(path(BIG, n)))
            refused = [reply for reply in replies if reply.status != 200]
            self.assertGreater(len(refused), 0, 'sixty tiles at once did not fill a queue of one')
            self.assertLess(len(refused), len(replies))
            for reply in refused:
                self.assertEqual(reply.status, 503, reply)
                self.assertEqual(reply.header('content-type'), 'application/problem+json')
                self.assertRegex(reply.header('retry-after', ''), r'^[1-9][0-9]*$')
                self.assertLessEqual(int(reply.header('retry-after')), 60)
                self.assertNotIn('etag', reply.headers)
                self.assertEqual(reply.header('cache-control'), 'no-store')
            self.assertEqual(daemon.metrics()['lodestone_tiles_refused_total'], len(refused))
            self.assertEqual(daemon.get(warm).status, 200)
            time.sleep(min(int(refused[0].header('retry-after')), 3))
            for n, reply in enumerate(replies):
                if reply.status == 503:
                    self.assertEqual(daemon.get(path(BIG, n)).status, 200)

    def test_clients_that_leave_take_their_work_with_them(self):
        with ld.Daemon(workspace.data_dir(), '--workers', '1', '--batch-tiles', '1', '--disk-cache-mib', '0') as daemon:
            daemon.get('/readyz')
            socks = [daemon.connect() for _ in range(200)]
            for n, sock in enumerate(socks):
                sock.sendall(f'GET /tiles/{BIG}/lsa/17/{n}/9.exr?compression=piz HTTP/1.1\r\nHost: a\r\n\r\n'.encode())
            for sock in socks:  # a reset: a mere end of sending would still be answered
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack('ii', 1, 0))
                sock.close()
            wait_until(lambda: daemon.metrics()['lodestone_queue_tiles'] == 0 and daemon.metrics()['lodestone_running_tiles'] == 0, 'an empty queue')
            wait_until(lambda: daemon.metrics()['lodestone_connections_open'] <= 1, 'closed connections')
            metrics = daemon.metrics()
            self.assertGreater(metrics['lodestone_tiles_cancelled_total'], 0)
            self.assertEqual(daemon.get(f'/tiles/{BIG}/lsa/17/3/9.exr').status, 200)

    def test_many_idle_connections_and_one_client(self):
        with ld.Daemon(workspace.data_dir(), *ON_HOST, '--max-connections', '200') as daemon:
            idle = [daemon.connect() for _ in range(150)]
            self.assertEqual(daemon.get('/healthz').status, 200)
            more = [daemon.connect() for _ in range(60)]
            wait_until(lambda: any(self.is_refused(sock) for sock in more), 'a refusal over the limit')
            for sock in idle + more:
                sock.close()
            wait_until(lambda: daemon.get('/healthz').status == 200, 'room again')

    @staticmethod
    def is_refused(sock):
        sock.settimeout(0.05)
        try:
            data = sock.recv(4096)
        except socket.timeout:
            return False
        except ConnectionResetError:
            return True
        return data == b'' or data.startswith(b'HTTP/1.1 503')

    def test_slow_and_silent_clients_are_let_go(self):
        with ld.Daemon(workspace.data_dir(), *ON_HOST, '--header-timeout-s', '1', '--idle-timeout-s', '1') as daemon:
            for start in (b'', b'GET /healthz HTTP/1.1\r\nHo'):
                with daemon.connect(timeout=8) as sock:
                    sock.sendall(start)
                    answer = b''
                    try:
                        while piece := sock.recv(4096):
                            answer += piece
                    except ConnectionResetError:
                        pass
                    self.assertTrue(answer == b'' or answer.startswith(b'HTTP/1.1 408'), answer)
            self.assertEqual(daemon.get('/healthz').status, 200)


class LifeCycle(unittest.TestCase):
    def test_sigterm_answers_what_is_in_flight_and_ends_with_zero(self):
        with ld.Daemon(workspace.data_dir(), '--workers', '1', '--disk-cache-mib', '0') as daemon:
            daemon.get('/readyz')
            count = 30
            socks = [daemon.connect() for _ in range(count)]
            for n, sock in enumerate(socks):
                sock.sendall(f'GET /tiles/{BIG}/lsa/16/{n}/5.exr?compression=piz HTTP/1.1\r\nHost: a\r\n\r\n'.encode())
            wait_until(lambda: sum(daemon.metrics()[f'lodestone_{name}'] for name in ('queue_tiles', 'running_tiles', 'tiles_generated_total')) >= count,
                       'all requests taken')
            daemon.signal(signal.SIGTERM)
            for sock in socks:
                self.assertEqual(ld.parsed_response(sock).status, 200)
                sock.close()
            self.assertEqual(daemon.wait(), 0)
            with self.assertRaises(OSError):
                daemon.connect()
            self.assertEqual(daemon.complaints(), [])

    def test_sigint_ends_with_zero_too(self):
        with ld.Daemon(workspace.data_dir(), *ON_HOST) as daemon:
            daemon.signal(signal.SIGINT)
            self.assertEqual(daemon.wait(), 0)

    def test_one_daemon_per_data_directory(self):
        data_dir = workspace.data_dir()
        with ld.Daemon(data_dir, *ON_HOST) as first:
            second = ld.run('serve', '--data-dir', data_dir, '--listen', '127.0.0.1:0', '--admin-listen', 'off', *ON_HOST)
            self.assertEqual(second.returncode, 1)
            self.assertIn('lock', second.stderr)
            self.assertIn(data_dir, second.stderr)
            self.assertEqual(first.get('/healthz').status, 200)
            first.restart(hard=True)  # a lock left by a killed daemon does not block
            self.assertEqual(first.get('/healthz').status, 200)

    def test_a_port_in_use_is_said(self):
        with socket.socket() as taken:
            taken.bind(('127.0.0.1', 0))
            taken.listen()
            port = taken.getsockname()[1]
            for flags in (('--listen', f'127.0.0.1:{port}', '--admin-listen', 'off'), ('--listen', '127.0.0.1:0', '--admin-listen', f'127.0.0.1:{port}')):
                done = ld.run('serve', '--data-dir', workspace.data_dir(), *ON_HOST, *flags)
                self.assertEqual(done.returncode, 1, done)
                self.assertIn(str(port), done.stderr)
                self.assertIn('in use', done.stderr)
        for listen in ('nonsense', '127.0.0.1', '127.0.0.1:99999', '127.0.0.1:http', '999.1.1.1:80', ':'):
            done = ld.run('serve', '--data-dir', workspace.data_dir(), '--listen', listen, '--admin-listen', 'off', *ON_HOST, timeout=20)
            self.assertIn(done.returncode, (1, 2), f'{listen}: {done}')
            self.assertIn(listen, done.stderr)

    def test_an_empty_data_directory_is_served(self):
        with ld.Daemon(workspace.path('empty'), *ON_HOST) as daemon:
            self.assertEqual(daemon.get('/layers').json(), {'layers': []})
            self.assertEqual(daemon.get('/readyz').status, 200)
            self.assertEqual(daemon.get('/', {'Accept': 'text/html'}).status, 200)
            self.assertEqual(daemon.get(f'/layers/{BIG}').status, 404)
            done = ld.run('ingest', ld.SAMPLE, '--layer', BIG, '--data-dir', daemon.data_dir)
            self.assertEqual(done.returncode, 0, done.stderr)
            self.assertEqual(daemon.admin('POST', '/reload', b'').json()['problems'], [])
            self.assertEqual(daemon.get(f'/tiles/{BIG}/lsa/2/1/1.f32').status, 200)

    def write(self, path, text):
        with open(path, 'w', encoding='utf-8') as file:
            file.write(text)

    def test_sighup_takes_a_good_configuration_and_refuses_a_broken_one(self):
        config = workspace.path('reload.toml')
        self.write(config, '[recipes.first]\nmethod = "gsa"\nseed = 3\n')
        tile = f'/tiles/{BIG}/{{}}/3/2/2.f32'
        with ld.Daemon(workspace.data_dir(), *ON_HOST, config=config) as daemon:
            first = daemon.get(tile.format('first'))
            self.assertEqual(first.status, 200)
            self.assertEqual(daemon.get(tile.format('second')).status, 404)
            for broken in ('[recipes.first]\nmethod = "gsaa"\n', '[recipes.first\n', 'memory_cache_mb = 3\n', 'workers = "many"\n'):
                before = daemon.metrics()['lodestone_config_reload_failed_total']
                self.write(config, broken)
                daemon.signal(signal.SIGHUP)
                wait_until(lambda: daemon.metrics()['lodestone_config_reload_failed_total'] == before + 1, 'a refused reload')
                self.assertEqual(daemon.get(tile.format('first')).body, first.body)
                self.assertRegex(daemon.log(), r'level=error .*reload\.toml:\d+:\d+')
            refused = daemon.admin('POST', '/reload', b'')
            self.assertEqual(refused.status, 400, refused)
            self.assertIn('reload.toml:1:', refused.json()['detail'])
            self.write(config, '[recipes.first]\nmethod = "gsa"\nseed = 4\n[recipes.second]\nmethod = "lsa"\nwindow = 5\n')
            daemon.signal(signal.SIGHUP)
            wait_until(lambda: daemon.get(tile.format('second')).status == 200, 'the new recipe')
            changed = daemon.get(tile.format('first'))
            self.assertNotEqual(changed.header('etag'), first.header('etag'))
            self.assertNotEqual(changed.body, first.body)
            self.assertEqual(changed.body, daemon.get(tile.format('gsa') + '?seed=4').body)
            self.assertIn('second', {recipe['name'] for recipe in daemon.layer()['recipes']})
            self.write(config, '')
            self.assertEqual(daemon.admin('POST', '/reload', b'').status, 200)
            self.assertEqual(daemon.get(tile.format('first')).status, 404)

    def test_purge_drops_tiles_and_changes_none(self):
        with ld.Daemon(workspace.data_dir(), *ON_HOST) as daemon:
            paths = [f'/tiles/{layer}/{recipe}/3/2/2.f32' for layer in (BIG, SMALL) for recipe in ('gsa', 'lsa')]
            bodies = [daemon.get(path).body for path in paths]
            self.assertEqual(daemon.generated(), 4)
            for query, removed in ((f'?layer={BIG}&recipe=lsa', 1), (f'?layer={SMALL}', 2), ('', 1)):
                done = daemon.admin('POST', f'/purge{query}', b'')
                self.assertEqual((done.status, done.json()['removed_on_disk']), (200, removed), query)
            self.assertEqual([daemon.get(path).body for path in paths], bodies)
            self.assertEqual(daemon.generated(), 8)
            self.assertEqual(daemon.admin('POST', '/purge?recipe=lsa', b'').status, 400)

    def test_access_log_has_a_line_per_request(self):
        log = workspace.path('access.log')
        with ld.Daemon(workspace.data_dir(), *ON_HOST, '--access-log', log) as daemon:
            daemon.get('/healthz', {'User-Agent': 'quote " and'})
            daemon.get('/nothing?a=\x1b[31m')
            daemon.raw(b'BROKEN\r\n\r\n')

            def lines_now():
                with open(log, encoding='utf-8') as file:
                    return file.read().splitlines()
            wait_until(lambda: os.path.exists(log) and len(lines_now()) >= 3, 'three lines')
            lines = lines_now()
            self.assertEqual([re.search(r'status=(\d+)', line)[1] for line in lines], ['200', '400', '400'])
            self.assertIn(r'quote \"', lines[0])
            self.assertFalse(any(c < ' ' for line in lines for c in line))
            self.assertTrue(all(re.search(r' id=\S+ .*ms=[0-9.]+ ', line) for line in lines))


if __name__ == '__main__':
    unittest.main()
