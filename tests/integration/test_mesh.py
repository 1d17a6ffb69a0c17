"""Meshes over HTTP: GLB and quantized-mesh parsed here, against the heights of the same tiles."""

import gzip
import json
import math
import struct
import unittest

import lodestone_daemon as support

GLOBE = 'globe'
EXTENSIONS = {'Accept': 'application/vnd.quantized-mesh;extensions=octvertexnormals-watermask-metadata,*/*;q=0.1'}


def read_glb(data):
    """(document, [(x, y, z)] with the node's translation, [triangles])."""
    magic, version, size, json_size = struct.unpack_from('<4sIII', data, 0)
    assert (magic, version, size) == (b'glTF', 2, len(data)), data[:12]
    document = json.loads(data[20:20 + json_size])
    binary = data[28 + json_size:]

    def values(number):
        accessor = document['accessors'][number]
        view = document['bufferViews'][accessor['bufferView']]
        code, width = {5126: ('f', 4), 5125: ('I', 4), 5123: ('H', 2)}[accessor['componentType']]
        count = {'SCALAR': 1, 'VEC2': 2, 'VEC3': 3}[accessor['type']]
        stride = view.get('byteStride', width * count)
        at = view.get('byteOffset', 0) + accessor.get('byteOffset', 0)
        return [struct.unpack_from(f'<{count}{code}', binary, at + n * stride) for n in range(accessor['count'])]

    primitive = document['meshes'][0]['primitives'][0]
    offset = document['nodes'][0]['translation']
    positions = [tuple(p + o for p, o in zip(v, offset)) for v in values(primitive['attributes']['POSITION'])]
    normals = values(primitive['attributes']['NORMAL'])
    indices = [v[0] for v in values(primitive['indices'])]
    return document, positions, normals, list(zip(indices[0::3], indices[1::3], indices[2::3]))


def read_terrain(data):
    header = struct.unpack_from('<3d2f7d', data, 0)
    low, high = header[3], header[4]
    count, = struct.unpack_from('<I', data, 88)
    at = 92
    columns = []
    for _ in range(3):
        value, out = 0, []
        for code in struct.unpack_from(f'<{count}H', data, at):
            value += (code >> 1) ^ -(code & 1)
            out.append(value)
        columns.append(out)
        at += 2 * count
    assert count <= 65536
    triangles, = struct.unpack_from('<I', data, at)
    at += 4
    highest, indices = 0, []
    for code in struct.unpack_from(f'<{3 * triangles}H', data, at):
        indices.append(highest - code)
        highest += code == 0
    at += 6 * triangles
    sides = {}
    for side in ('west', 'south', 'east', 'north'):
        n, = struct.unpack_from('<I', data, at)
        sides[side] = struct.unpack_from(f'<{n}H', data, at + 4)
        at += 4 + 2 * n
    extensions = {}
    while at < len(data):
        number, size = struct.unpack_from('<BI', data, at)
        extensions[number] = data[at + 5:at + 5 + size]
        at += 5 + size
    vertices = [(u, v, low + (high - low) * h / 32767) for u, v, h in zip(*columns)]
    return vertices, list(zip(indices[0::3], indices[1::3], indices[2::3])), sides, extensions


def worst_error(vertices, triangles, heights, posts):
    """Largest |surface - post|; vertices as (column, row, height). Every post must be covered."""
    covered = [False] * (posts * posts)
    worst = 0
    for triangle in triangles:
        (ax, ay, ah), (bx, by, bh), (cx, cy, ch) = (vertices[n] for n in triangle)
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        for row in range(math.ceil(min(ay, by, cy) - 1e-6), math.floor(max(ay, by, cy) + 1e-6) + 1):
            for column in range(math.ceil(min(ax, bx, cx) - 1e-6), math.floor(max(ax, bx, cx) + 1e-6) + 1):
                b = ((column - ax) * (cy - ay) - (cx - ax) * (row - ay)) / area
                c = ((bx - ax) * (row - ay) - (column - ax) * (by - ay)) / area
                if b < -1e-6 or c < -1e-6 or b + c > 1 + 1e-6:
                    continue
                worst = max(worst, abs(ah + b * (bh - ah) + c * (ch - ah) - heights[row * posts + column]))
                covered[row * posts + column] = True
    assert all(covered), f'{covered.count(False)} posts are not covered'
    return worst


class Mesh(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.workspace = support.Workspace()
        cls.addClassCleanup(cls.workspace.remove)
        data = cls.workspace.data_dir()
        done = support.run('ingest', support.SAMPLE, '--layer', GLOBE, '--data-dir', data, '--grid', 'WorldCRS84Quad', '--posts-per-tile', '65')
        assert done.returncode == 0, done.stderr
        cls.daemon = support.Daemon(data)
        cls.addClassCleanup(cls.daemon.kill)
        cls.small = cls.daemon.layer(support.SMALL)
        cls.globe = cls.daemon.layer(GLOBE)

    def posts_of(self, z, x, y, query):
        """Vertices of a GLB as (column, row, height), normals by place, triangles, the reply."""
        reply = self.daemon.tile(support.SMALL, 'lsa', z, x, y, 'glb', query)
        document, positions, normals, triangles = read_glb(reply.body)
        up = 2.0 ** (self.small['base_level'] - z)
        sx, sy = (c * up for c in self.small['cell_m'])
        vertices = [(px / sx - 64 * x, pz / sy - 64 * y, h) for px, h, pz in positions]
        return document, vertices, normals, triangles, reply

    def test_glb_keeps_the_asked_error(self):
        for z, x, y in ((3, 1, 1), (2, 0, 0), (5, 9, 9)):
            heights = self.daemon.tile(support.SMALL, 'lsa', z, x, y).f32()
            for error in (1, 8, 40):
                _, vertices, _, triangles, reply = self.posts_of(z, x, y, f'error={error}')
                told = float(reply.header('lodestone-max-error-m'))
                worst = worst_error([(round(a), round(b), h) for a, b, h in vertices], triangles, heights, 65)
                self.assertLessEqual(told, error * 1.0001)
                self.assertAlmostEqual(worst, told, delta=2e-3)
                self.assertLess(max(abs(a - round(a)) for a, _, _ in vertices), 1e-2)

    def test_neighbours_share_vertices_and_normals(self):
        for z, x, y in ((2, 0, 0), (3, 1, 1), (5, 9, 9), (7, 40, 40)):
            for query in ('error=5', 'error=0.5', 'triangles=200'):
                def side(tile_x, column):
                    _, vertices, normals, _, _ = self.posts_of(z, tile_x, y, query)
                    return {round(b): (h, n) for (a, b, h), n in zip(vertices, normals) if round(a) == column}
                west, east = side(x, 64), side(x + 1, 0)
                self.assertEqual(set(west), set(east), (z, query))
                for row, (height, normal) in west.items():
                    self.assertAlmostEqual(height, east[row][0], delta=1e-3)
                    self.assertLess(math.dist(normal, east[row][1]), 1e-5)

    def test_budget_skirt_and_grid(self):
        document, _, _, triangles, _ = self.posts_of(3, 1, 1, 'triangles=300')
        self.assertLessEqual(len(triangles), 300)
        plain = self.posts_of(3, 1, 1, 'error=8')
        skirt = self.posts_of(3, 1, 1, 'error=8&skirt=25')
        self.assertEqual(skirt[0]['meshes'][0]['extras']['topTriangles'], len(plain[3]))
        self.assertGreater(len(skirt[3]), len(plain[3]))
        self.assertEqual(skirt[0]['meshes'][0]['extras']['skirtDepthM'], 25)
        _, _, _, triangles, reply = self.posts_of(3, 1, 1, 'mesh=grid')
        self.assertEqual((len(triangles), float(reply.header('lodestone-max-error-m'))), (2 * 64 * 64, 0))

    def test_wrong_options_are_400(self):
        for query in ('mesh=bitree', 'error=-1', 'error=nan', 'triangles=1', 'skirt=deep', 'mesh=grid&error=2', 'frame=ecef', 'zones=a'):
            reply = self.daemon.get(f'/tiles/{support.SMALL}/lsa/3/1/1.glb?{query}')
            self.assertEqual(reply.status, 400, query)
        self.assertEqual(self.daemon.get(f'/tiles/{support.SMALL}/lsa/3/1/1.terrain').status, 400)
        self.assertEqual(self.daemon.get(f'/tiles/{support.SMALL}/lsa/layer.json').status, 400)

    def test_layer_json_tells_exactly_what_is_answered(self):
        layer = self.daemon.get(f'/tiles/{GLOBE}/lsa/layer.json').json()
        self.assertEqual((layer['format'], layer['scheme'], layer['projection']), ('quantized-mesh-1.0', 'tms', 'EPSG:4326'))
        self.assertEqual(len(layer['available']), layer['maxzoom'] + 1)
        for z in (0, 1, 2, self.globe['base_level'], self.globe['base_level'] + 1):
            box, = layer['available'][z]
            for dx, dy in ((0, 0), (-1, 0), (0, -1)):
                status = self.daemon.get(f'/cesium/{GLOBE}/lsa/{z}/{box["startX"] + dx}/{box["startY"] + dy}.terrain').status
                is_address = box['startX'] + dx >= 0 and box['startY'] + dy >= 0
                self.assertEqual(status, 200 if (dx, dy) == (0, 0) else 404 if is_address else 400, (z, dx, dy))
            for dx, dy in ((0, 0), (1, 0), (0, 1)):
                status = self.daemon.get(f'/cesium/{GLOBE}/lsa/{z}/{box["endX"] + dx}/{box["endY"] + dy}.terrain').status
                self.assertEqual(status, 200 if (dx, dy) == (0, 0) else 404, (z, dx, dy))

    def test_terrain_keeps_the_asked_error_and_its_edges(self):
        z = self.globe['base_level']
        box, = self.daemon.get(f'/tiles/{GLOBE}/lsa/layer.json').json()['available'][z]
        x, y = box['startX'] + 2, box['startY'] + 2
        for error in (4, 20):
            reply = self.daemon.get(f'/cesium/{GLOBE}/lsa/{z}/{x}/{y}.terrain?error={error}')
            told = float(reply.header('lodestone-max-error-m'))
            self.assertLessEqual(told, error * 1.0001)
            vertices, triangles, sides, _ = read_terrain(reply.body)
            heights = self.daemon.tile(GLOBE, 'lsa', z, x, 2 ** z - 1 - y).f32()
            placed = [(u * 64 / 32767, 64 - v * 64 / 32767, h) for u, v, h in vertices]
            self.assertLessEqual(worst_error(placed, triangles, heights, 65), told + 1e-3)
            east = {vertices[n][1]: vertices[n][2] for n in sides['east']}
            reply = self.daemon.get(f'/cesium/{GLOBE}/lsa/{z}/{x + 1}/{y}.terrain?error={error}')
            vertices, _, sides, _ = read_terrain(reply.body)
            west = {vertices[n][1]: vertices[n][2] for n in sides['west']}
            self.assertEqual(set(east), set(west))
            for v, height in east.items():
                self.assertAlmostEqual(height, west[v], delta=0.05)

    def test_extensions_and_coding_follow_the_request(self):
        path = f'/cesium/{GLOBE}/lsa/0/0/0.terrain'
        plain = self.daemon.get(path)
        self.assertEqual(plain.header('vary'), 'Accept, Accept-Encoding')
        self.assertIsNone(plain.header('content-encoding'))
        self.assertEqual(read_terrain(plain.body)[3], {})
        rich = self.daemon.get(path, EXTENSIONS)
        vertices, _, _, extensions = read_terrain(rich.body)
        self.assertEqual(set(extensions), {1, 2, 4})
        self.assertEqual(len(vertices), 33 * 33)  # round enough for a globe
        self.assertEqual(len(extensions[1]), 2 * len(vertices))
        self.assertIn('geometricerror', json.loads(extensions[4][4:]))
        coded = self.daemon.get(path, {**EXTENSIONS, 'Accept-Encoding': 'gzip'})
        self.assertEqual(coded.header('content-encoding'), 'gzip')
        self.assertEqual(gzip.decompress(coded.body), rich.body)
        self.assertEqual(len({plain.header('etag'), rich.header('etag'), coded.header('etag')}), 3)
        again = self.daemon.get(path, {**EXTENSIONS, 'Accept-Encoding': 'gzip', 'If-None-Match': coded.header('etag')})
        self.assertEqual((again.status, again.header('vary')), (304, plain.header('vary')))
        self.assertEqual({h for _, _, h in read_terrain(self.daemon.get(f'/cesium/{GLOBE}/lsa/0/1/0.terrain').body)[0]}, {0.0})


if __name__ == '__main__':
    unittest.main()
