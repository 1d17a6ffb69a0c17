"""Wrong requests: each is refused with a problem that names the value and the rule, quickly, and costs no tile."""

import http.client
import io
import json
import re
import time
import unittest

import lodestone_daemon as ld
from lodestone_daemon import BIG

TILE = f'/tiles/{BIG}/lsa/3/2/2.exr'
# A refusal costs no computation; the limit leaves room for a busy machine.
QUICK_S = 0.25


def setUpModule():
    global workspace
    workspace = ld.Workspace()


def tearDownModule():
    workspace.remove()


def first_response(data, method='GET'):
    """The first response in raw bytes."""
    class Bytes:
        def makefile(self, *_):
            return io.BytesIO(data)
    reply = http.client.HTTPResponse(Bytes(), method=method)
    reply.begin()
    return ld.Response(reply.status, {k.lower(): v for k, v in reply.getheaders()}, reply.read())


class BadRequests(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.daemon = ld.Daemon(workspace.data_dir())
        cls.addClassCleanup(cls.daemon.kill)
        cls.daemon.get('/readyz')

    def setUp(self):
        self.made = self.daemon.generated()

    def tearDown(self):
        self.assertEqual(self.daemon.generated(), self.made, 'a refused request made tiles')
        self.assertEqual(self.daemon.get('/healthz').status, 200)
        self.assertIsNone(self.daemon.process.poll())

    def check_problem(self, reply, statuses, names=(), label=''):
        statuses = (statuses,) if isinstance(statuses, int) else statuses
        self.assertIn(reply.status, statuses, f'{label}: {reply}')
        self.assertEqual(reply.header('content-type'), 'application/problem+json', label)
        self.assertIn('no-store', reply.header('cache-control', ''), label)
        problem = reply.json()
        self.assertEqual(problem['status'], reply.status)
        for member in ('type', 'title', 'detail'):
            self.assertIsInstance(problem[member], str)
        self.assertGreater(len(problem['detail']), 10, label)
        for name in names:
            self.assertIn(name, problem['detail'], label)
        self.assertTrue(all(c >= ' ' for c in problem['detail']))
        self.assertLess(len(reply.body), 4000, label)

    def refuse(self, path, statuses, *names, method='GET', headers=None, body=None):
        for _ in range(3):  # a busy machine may hold one answer up, not three
            start = time.monotonic()
            reply = self.daemon.request(method, path, headers, body)
            took = time.monotonic() - start
            if took < QUICK_S:
                break
        self.check_problem(reply, statuses, names, f'{method} {path}')
        self.assertLess(took, QUICK_S, path)
        return reply

    def test_tile_addresses(self):
        for z in ('-1', '99', '18', '31', '32', '63', '64', '2147483648', '4294967296', '9223372036854775807', '9223372036854775808',
                  '18446744073709551616', '1' * 300):
            self.refuse(f'/tiles/{BIG}/lsa/{z}/0/0.exr', 400 if z == '-1' else 404, z[:20])
        for z in ('', 'a', '+1', '01', '1.0', '1e1', '0x1', '٣', ' 1', '1_0', 'NaN'):
            quoted = ''.join(chr(b) if 33 <= b < 127 else f'%{b:02x}' for b in z.encode())
            self.refuse(f'/tiles/{BIG}/lsa/{quoted}/0/0.exr', (400, 404))
        for x in ('4', '-1', '2147483647', '9000000000000000000', '99999999999999999999', '00', '1a', '%20'):
            self.refuse(f'/tiles/{BIG}/lsa/3/{x if x != "4" else "7"}/0.exr', (400, 404))
            self.refuse(f'/tiles/{BIG}/lsa/3/0/{x if x != "4" else "6"}.exr', (400, 404))
        self.refuse(f'/tiles/{BIG}/lsa/17/9999999999/0.exr', 404, '9999999999', 'x 0..')
        self.refuse(f'/tiles/{BIG}/lsa/18/0/0.exr', 404, '18', '0..17')

    def test_names(self):
        self.refuse('/tiles/nowhere/lsa/3/2/2.exr', 404, 'layer', 'nowhere', BIG)
        self.refuse(f'/tiles/{BIG}/nothing/3/2/2.exr', 404, 'recipe', 'nothing', 'lsa')
        self.refuse(f'/tiles/{BIG}/lsa/3/2/2.bmp', 404, 'bmp', 'exr')
        self.refuse(f'/tiles/{BIG}/LSA/3/2/2.exr', 404, 'LSA')
        for path in ('/layers/nowhere', '/heights/nowhere/lsa?lon=0&lat=0', '/tiles/nowhere/lsa/tilejson.json'):
            self.refuse(path, 404, 'nowhere')
        for path in (f'/tiles/{BIG}/nothing/tilejson.json', f'/heights/{BIG}/nothing?lon=-84.3&lat=36.6'):
            self.refuse(path, 404, 'nothing')
        for path in ('/nothing', '/tiles', '/tiles/', f'/tiles/{BIG}', f'/tiles/{BIG}/lsa/3/2/2', f'/tiles/{BIG}/lsa/3/2/2.', f'/tiles/{BIG}/lsa/3/2/.exr',
                     f'/tiles/{BIG}/lsa/3/2/2.exr/', f'/tiles//lsa/3/2/2.exr', '//', '/layers/', f'/layers/{BIG}/', '/favicon.ico'):
            self.refuse(path, (400, 404))

    def test_seeds(self):
        for seed in ('-1', '18446744073709551616', '1.5', 'x', '', '0x10', '1e3', '%201', '1%00', '99999999999999999999999999'):
            self.refuse(f'{TILE}?seed={seed}', 400)
        self.refuse(f'{TILE}?seed=abc', 400, 'abc', '0..18446744073709551615')
        self.refuse(f'/heights/{BIG}/lsa?lon=-84.3&lat=36.6&seed=-5', 400, '-5')

    def test_queries(self):
        for query, names in (('compression=lzw', ('lzw', 'none, zip, piz')), ('pixel=int', ('int', 'half')), ('channels=Z', ('Z', 'provenance')),
                             ('quantum=0.3', ('0.3', 'power of two')), ('quantum=128', ('128',)), ('quantum=-1', ('-1',)), ('quantum=nan', ('nan',)),
                             ('colour=red', ('colour', 'compression')), ('encoding=terrarium', ('encoding', '.exr')), ('size=257', ('size',)),
                             ('seed=1&seed=2', ('seed', 'twice')), ('v=nonsense', ('nonsense', '16 hex')), ('COMPRESSION=zip', ('COMPRESSION',))):
            self.refuse(f'{TILE}?{query}', 400, *names)
        png = f'/tiles/{BIG}/lsa/3/2/2.png'
        for query, names in (('encoding=mars', ('mars', 'terrarium')), ('size=512', ('512', '256', '257')), ('compression=zip', ('compression', '.png'))):
            self.refuse(f'{png}?{query}', 400, *names)
        for path in ('/layers?x=1', f'/layers/{BIG}?f=json', '/?a=b', f'/tiles/{BIG}/lsa/tilejson.json?colour=1'):
            self.refuse(path, 400, 'unknown query key')
        self.refuse(f'/tiles/{BIG}/lsa/tilejson.json?encoding=mars', 400, 'mars')
        for query, names in (('lat=36.6', ('lon',)), ('lon=-84.3', ('lat',)), ('lon=a&lat=36.6', ('lon=a',)), ('lon=-84.3&lat=91', ('lat=91',)),
                             ('lon=181&lat=0', ('lon=181',)), ('lon=nan&lat=0', ('nan',)), ('lon=inf&lat=0', ('inf',)), ('lon=-84.3&lat=36.6&z=99', ('z=99',)),
                             ('lon=-84.3&lat=36.6&z=-1', ('z=-1',)), ('lon=-84.3&lat=36.6&z=x', ('z=x',)), ('lon=-84.3&lat=36.6&w=1', ('w',))):
            self.refuse(f'/heights/{BIG}/lsa?{query}', 400, *names)
        self.refuse(f'/heights/{BIG}/lsa?lon=0&lat=0', 404, 'outside', BIG)

    def test_a_stale_revision_is_gone_and_a_garbled_one_is_wrong(self):
        for path in (TILE, f'/tiles/{BIG}/lsa/tilejson.json', f'/heights/{BIG}/lsa?lon=-84.3&lat=36.6'):
            join = '&' if '?' in path else '?'
            self.refuse(f'{path}{join}v=0123456789abcdef', 410, '0123456789abcdef')
            self.refuse(f'{path}{join}v=garbage', 400, 'garbage')

    def test_height_bodies(self):
        path = f'/heights/{BIG}/lsa'
        point = [-84.3, 36.6]
        for body in (b'', b'null', b'[]', b'{', b'{"points": 3}', b'{"points": [[1]]}', b'{"points": [[1, 2, 3]]}', b'{"points": [["a", "b"]]}',
                     b'{"points": [[500, 0]]}', b'{"points": [[NaN, 0]]}', json.dumps({'points': [point], 'z': 99}).encode(),
                     json.dumps({'points': [point], 'z': 1.5}).encode(), json.dumps({'points': [point], 'seed': -1}).encode(),
                     json.dumps({'points': [point], 'colour': 1}).encode(), b'\xff\xfe\x00', b'[' * 20000):
            self.refuse(path, 400, method='POST', body=body)
        self.refuse(path, 413, '4097', method='POST', body=json.dumps({'points': [point] * 4097}).encode())
        self.refuse(path, 413, method='POST', body=b' ' * (2 << 20))

    def test_segments_that_climb_or_hide(self):
        for segment in ('..', '%2e%2e', '%2E%2e', '.', '%2e', '..%2f..', '%2f', '%5c', '..%5c..', '%00', 'a%00b', '%0a', '%0d%0aX:1', '%7f', '%c0%ae%c0%ae',
                        '%ff', '%ed%a0%80'):
            for path in (f'/tiles/{segment}/lsa/3/2/2.exr', f'/tiles/{BIG}/{segment}/3/2/2.exr', f'/layers/{segment}', f'/tiles/{BIG}/lsa/3/{segment}/2.exr',
                         f'/tiles/{BIG}/lsa/3/2/{segment}.exr'):
                reply = self.refuse(path, (400, 404))
                self.assertNotIn(b'\r', reply.body)
                self.assertNotIn('x', reply.headers)
        for path in ('/../etc/passwd', '/tiles/../../etc/passwd', '/%2e%2e/%2e%2e/etc/passwd', '/viewer/../../etc/passwd'):
            self.assertNotIn(b'root:', self.refuse(path, (400, 404)).body)

    def test_broken_percent_escapes(self):
        for segment in ('%', '%2', '%zz', '%%20', 'a%', '%u0041', '%+1'):
            self.refuse(f'/layers/{segment}', 400)
            self.refuse(f'{TILE}?seed={segment}', 400)

    def test_methods(self):
        for method in ('POST', 'PUT', 'DELETE', 'PATCH', 'TRACE'):
            reply = self.refuse(TILE, 405, method, 'GET, HEAD, OPTIONS', method=method, body=b'' if method != 'TRACE' else None)
            self.assertEqual(reply.header('allow'), 'GET, HEAD, OPTIONS')
        reply = self.refuse(f'/heights/{BIG}/lsa', 405, method='DELETE')
        self.assertEqual(set(reply.header('allow').split(', ')), {'GET', 'HEAD', 'POST', 'OPTIONS'})
        for method in ('BREW', 'get', 'PROPFIND'):
            self.refuse(TILE, 501, method, method=method)
        self.refuse('/purge', 404, method='POST', body=b'')
        self.refuse('/reload', 404, method='POST', body=b'')
        self.refuse(f'/layers/{BIG}/masks/roads', 404, method='PUT', body=b'x', headers={'Authorization': f'Bearer {ld.TOKEN}'})

    def test_framing(self):
        host = b'Host: localhost\r\n'
        line = f'GET {TILE} HTTP/1.1\r\n'.encode()
        cases = [
            ('request line of 9 kB', b'GET /' + b'a' * 9000 + b' HTTP/1.1\r\n' + host + b'\r\n', (414,)),
            ('header fields of 20 kB', line + host + b'X-Long: ' + b'a' * 20000 + b'\r\n\r\n', (431,)),
            ('200 header fields', line + host + b''.join(b'X-%d: 1\r\n' % n for n in range(200)) + b'\r\n', (431,)),
            ('length and chunks', f'POST /heights/{BIG}/lsa HTTP/1.1\r\n'.encode() + host +
             b'Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n', (400,)),
            ('two lengths', f'POST /heights/{BIG}/lsa HTTP/1.1\r\n'.encode() + host + b'Content-Length: 2\r\nContent-Length: 3\r\n\r\n{} ', (400,)),
            ('length of words', f'POST /heights/{BIG}/lsa HTTP/1.1\r\n'.encode() + host + b'Content-Length: two\r\n\r\n{}', (400,)),
            ('negative length', f'POST /heights/{BIG}/lsa HTTP/1.1\r\n'.encode() + host + b'Content-Length: -2\r\n\r\n{}', (400,)),
            ('no Host', line + b'\r\n', (400,)),
            ('two Hosts', line + host + host + b'\r\n', (400,)),
            ('Host with a space', line + b'Host: a b\r\n\r\n', (400,)),
            ('no version', b'GET /healthz\r\n' + host + b'\r\n', (400, 505)),
            ('HTTP/2.0', b'GET /healthz HTTP/2.0\r\n' + host + b'\r\n', (505,)),
            ('TLS greeting', b'\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03' + bytes(40), (400,)),
            ('bare LF', b'GET /healthz HTTP/1.1\nHost: localhost\n\n', (400,)),
            ('folded field', line + host + b'X-A: 1\r\n 2\r\n\r\n', (400,)),
            ('space before colon', line + host + b'X-A : 1\r\n\r\n', (400,)),
            ('NUL in a field', line + host + b'X-A: 1\x002\r\n\r\n', (400,)),
            ('NUL in the target', b'GET /lay\x00ers HTTP/1.1\r\n' + host + b'\r\n', (400,)),
            ('unknown transfer coding', f'POST /heights/{BIG}/lsa HTTP/1.1\r\n'.encode() + host + b'Transfer-Encoding: gzip\r\n\r\n', (400, 501)),
            ('bad chunk size', f'POST /heights/{BIG}/lsa HTTP/1.1\r\n'.encode() + host + b'Transfer-Encoding: chunked\r\n\r\nzz\r\n', (400,)),
            ('unknown expectation', line + host + b'Expect: tea\r\n\r\n', (417,)),
            ('too large before sending', f'POST /heights/{BIG}/lsa HTTP/1.1\r\n'.encode() + host +
             b'Content-Length: 99999999999\r\nExpect: 100-continue\r\n\r\n', (413,)),
        ]
        for label, data, statuses in cases:
            with self.subTest(label):
                start = time.monotonic()
                answer = self.daemon.raw(data)
                self.assertLess(time.monotonic() - start, 5, 'the connection was left open')
                self.check_problem(first_response(answer), statuses, label=label)
                self.assertEqual(len(re.findall(rb'HTTP/1\.1 [0-9]{3} ', answer)), 1, answer)

    def test_accepted_oddities(self):
        """What is legal is not refused: absolute-form, extra slashes in a query, HTTP/1.0 without Host, pipelining."""
        host = '{}:{}'.format(*self.daemon.address)
        self.assertEqual(self.daemon.raw_response(f'GET http://{host}/healthz HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n'.encode()).status, 200)
        self.assertEqual(first_response(self.daemon.raw(b'GET /healthz HTTP/1.0\r\n\r\n')).status, 200)
        many = self.daemon.raw(b'GET /healthz HTTP/1.1\r\nHost: a\r\n\r\n' * 49 + b'GET /nothing HTTP/1.1\r\nHost: a\r\nConnection: close\r\n\r\n')
        self.assertEqual(many.count(b'HTTP/1.1 200 OK'), 49)
        self.assertEqual(many.count(b'HTTP/1.1 404 '), 1)
        self.assertGreater(many.rindex(b'HTTP/1.1 404 '), many.rindex(b'HTTP/1.1 200 OK'))

    def test_refusal_of_every_coding(self):
        self.refuse(TILE, 406, headers={'Accept-Encoding': 'identity;q=0, br'})


if __name__ == '__main__':
    unittest.main()
