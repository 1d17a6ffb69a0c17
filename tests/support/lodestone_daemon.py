"""Harness of the black-box tests: a real daemon on free ports, and readers for what it serves. Standard library only."""

import array
import contextlib
import http.client
import json
import os
import re
import select
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
import zipfile
import zlib

SOURCE_DIR = os.path.abspath(os.path.join(os.path.dirname(__file__), '..', '..'))
SAMPLE = os.path.join(SOURCE_DIR, 'config', 'jacksboro.vrt')
TOKEN = 'token-of-the-tests'
START_LIMIT_S = 60

# One layer with the default tiles (base level 1), one with small tiles (base level 3) for arithmetic in plain Python.
BIG, SMALL = 'jacksboro', 'small'
WAVELET_RECIPES = ('linear', 'gsa', 'lsa')
ALL_RECIPES = WAVELET_RECIPES + ('square-square', 'diamond-square', 'fractal-wavelet')


def program():
    path = os.environ.get('LODESTONE_BIN')
    if not path:
        raise RuntimeError('set LODESTONE_BIN to the program under test (ctest does)')
    return path


def clean_environment(extra=None):
    """Our environment without LODESTONE_*, so that a developer's own settings do not reach the program."""
    env = {k: v for k, v in os.environ.items() if not k.startswith('LODESTONE_')}
    env.update(extra or {})
    return env


def run(*args, env=None, text=True, timeout=120):
    """The command line program; returns CompletedProcess with returncode, stdout, stderr."""
    return subprocess.run([program(), *map(str, args)], env=clean_environment(env), stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE, text=text, errors='replace' if text else None, timeout=timeout, check=False)


class Workspace:
    """A temporary folder with the sample ingested once; copies of the data directory are cheap."""

    def __init__(self):
        self.root = tempfile.mkdtemp(prefix='lodestone-test-')
        self.template = os.path.join(self.root, 'template')
        self._count = 0
        for layer, options in ((BIG, []), (SMALL, ['--posts-per-tile', '65'])):
            done = run('ingest', SAMPLE, '--layer', layer, '--data-dir', self.template, '--datum', 'EGM96', *options)
            if done.returncode != 0:
                raise RuntimeError(f'ingest of the sample failed ({done.returncode}): {done.stderr}')
        # Once on the device, so that every copy brings the compiled kernels along.
        with Daemon(self.template) as daemon:
            for recipe in ALL_RECIPES:
                daemon.tile(SMALL, recipe, 4, 0, 0)
            if daemon.stop() != 0:
                raise RuntimeError(f'the first daemon did not end well: {daemon.log()}')
        shutil.rmtree(os.path.join(self.template, 'cache'), ignore_errors=True)

    def path(self, name):
        return os.path.join(self.root, name)

    def data_dir(self):
        """A fresh copy of the ingested data directory."""
        self._count += 1
        target = self.path(f'data-{self._count}')
        shutil.copytree(self.template, target)
        return target

    def remove(self):
        shutil.rmtree(self.root, ignore_errors=True)


class Response:
    def __init__(self, status, headers, body):
        self.status, self.headers, self.body = status, headers, body

    def header(self, name, default=None):
        return self.headers.get(name.lower(), default)

    def json(self):
        return json.loads(self.body)

    def f32(self):
        return f32_values(self.body)

    def __repr__(self):
        return f'<{self.status} {self.body[:300]!r}>'


def parsed_response(sock, method='GET'):
    reply = http.client.HTTPResponse(sock, method=method)
    reply.begin()
    body = reply.read()
    headers = {}
    for name, value in reply.getheaders():
        headers[name.lower()] = value if name.lower() not in headers else headers[name.lower()] + ', ' + value
    return Response(reply.status, headers, body)


class Daemon:
    """`lodestone serve` on 127.0.0.1:0; use as a context manager, or stop() it."""

    def __init__(self, data_dir, *flags, env=None, config=None, token=TOKEN):
        self.data_dir = data_dir
        self.flags = list(flags)
        self.config = config
        self.env = dict(env or {})
        if token is not None:
            self.env['LODESTONE_ADMIN_TOKEN'] = token
        self.token = token
        self.log_file = data_dir.rstrip('/') + '.log'
        self.process = None
        self.start()

    def start(self):
        command = [program(), 'serve', '--data-dir', self.data_dir, '--listen', '127.0.0.1:0', '--admin-listen', '127.0.0.1:0']
        if self.config:
            command += ['--config', self.config]
        with open(self.log_file, 'ab') as log:
            self.log_start = log.tell()
            self.process = subprocess.Popen(command + self.flags, env=clean_environment(self.env), stdout=subprocess.PIPE, stderr=log)
        self.address = self._printed(rb'listening on http://([0-9.]+):(\d+)/')
        self.admin_address = self._printed(rb'admin on http://([0-9.]+):(\d+)/')

    def _printed(self, pattern):
        deadline = time.monotonic() + START_LIMIT_S
        text = getattr(self, '_stdout', b'')
        while not (found := re.search(pattern, text)):
            ready, _, _ = select.select([self.process.stdout], [], [], max(0, deadline - time.monotonic()))
            piece = os.read(self.process.stdout.fileno(), 4096) if ready else b''
            if not piece:
                self.process.kill()
                self.process.wait()
                raise RuntimeError(f'the daemon did not start: printed {text!r}, log: {self.log()}')
            text += piece
        self._stdout = text
        return found.group(1).decode(), int(found.group(2))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.kill()

    def signal(self, number):
        self.process.send_signal(number)

    def wait(self, timeout=30):
        code = self.process.wait(timeout)
        self.process.stdout.close()
        self._stdout = b''
        return code

    def stop(self, timeout=30):
        """SIGTERM; returns the exit status."""
        self.signal(signal.SIGTERM)
        return self.wait(timeout)

    def kill(self):
        if self.process and self.process.poll() is None:
            self.process.kill()
        if self.process and not self.process.stdout.closed:
            self.wait()

    def restart(self, *flags, hard=False):
        if hard:
            self.kill()
        else:
            self.stop()
        if flags:
            self.flags = list(flags)
        self.start()

    def log(self):
        with open(self.log_file, 'rb') as log:
            log.seek(self.log_start)
            return log.read().decode(errors='replace')

    def complaints(self):
        """Log lines at level warn or above since the last start."""
        return [line for line in self.log().splitlines() if re.search(r'level=(warn|error|critical)', line) or 'level=' not in line]

    def connect(self, admin=False, timeout=60):
        return socket.create_connection(self.admin_address if admin else self.address, timeout=timeout)

    def request(self, method, path, headers=None, body=None, admin=False, timeout=60):
        """One request on a connection of its own. `path` goes out as it is given."""
        host, port = self.admin_address if admin else self.address
        fields = {'Host': f'{host}:{port}', 'Connection': 'close', **(headers or {})}
        if body is not None:
            fields.setdefault('Content-Length', str(len(body)))
        head = f'{method} {path} HTTP/1.1\r\n' + ''.join(f'{k}: {v}\r\n' for k, v in fields.items() if v is not None) + '\r\n'
        with self.connect(admin, timeout) as sock:
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                sock.sendall(head.encode('latin-1') + (body or b''))
            return parsed_response(sock, method)

    def get(self, path, headers=None, **more):
        return self.request('GET', path, headers, **more)

    def admin(self, method, path, body=None, headers=None):
        fields = dict(headers or {})
        fields.setdefault('Authorization', f'Bearer {self.token}')
        return self.request(method, path, fields, body, admin=True)

    def tile(self, layer, recipe, z, x, y, ext='f32', query=''):
        reply = self.get(f'/tiles/{layer}/{recipe}/{z}/{x}/{y}.{ext}' + (f'?{query}' if query else ''))
        if reply.status != 200:
            raise AssertionError(f'tile {layer}/{recipe}/{z}/{x}/{y}.{ext}?{query}: {reply}')
        return reply

    def raw(self, data, admin=False, timeout=20):
        """Sends bytes as they are; returns all that comes back until the daemon closes or is silent for a second."""
        with self.connect(admin, timeout) as sock:
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                sock.sendall(data)
            out = b''
            sock.settimeout(1)
            with contextlib.suppress(socket.timeout, ConnectionResetError):
                while piece := sock.recv(65536):
                    out += piece
            return out

    def raw_response(self, data, method='GET'):
        with self.connect() as sock:
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                sock.sendall(data)
            return parsed_response(sock, method)

    def metrics(self):
        return metric_values(self.get('/metrics').body.decode())

    def generated(self):
        return self.metrics()['lodestone_tiles_generated_total']

    def layer(self, name=BIG):
        return self.get(f'/layers/{name}').json()


def metric_values(text):
    """{'name{labels}': value} of a Prometheus text."""
    values = {}
    for line in text.splitlines():
        if line and not line.startswith('#'):
            name, value = line.rsplit(' ', 1)
            values[name] = float(value)
    return values


# --- Readers -----------------------------------------------------------------------------------------------------------

def f32_values(data):
    values = array.array('f')
    values.frombytes(data)
    if sys.byteorder == 'big':
        values.byteswap()
    return values


class Grid:
    """Heights row by row from the north-west."""

    def __init__(self, width, height, values):
        if len(values) != width * height:
            raise AssertionError(f'{width} x {height} posts expected, {len(values)} found')
        self.width, self.height, self.values = width, height, values

    @classmethod
    def square(cls, values):
        edge = round(len(values) ** 0.5)
        return cls(edge, edge, values)

    def at(self, column, row):
        return self.values[row * self.width + column]

    def row(self, row):
        return self.values[row * self.width:(row + 1) * self.width]

    def column(self, column):
        return self.values[column::self.width]


def _exr_attributes(data):
    attributes, at = {}, 8
    while data[at] != 0:
        name_end = data.index(b'\0', at)
        type_end = data.index(b'\0', name_end + 1)
        size, = struct.unpack_from('<i', data, type_end + 1)
        start = type_end + 5
        attributes[data[at:name_end].decode()] = (data[name_end + 1:type_end].decode(), data[start:start + size])
        at = start + size
    return attributes, at + 1


def _exr_undo_zip(data, size):
    if len(data) == size:  # a block that would have grown is stored as it is
        return data
    raw = bytearray(zlib.decompress(data))
    for n in range(1, len(raw)):
        raw[n] = (raw[n - 1] + raw[n] - 128) & 255
    half = (len(raw) + 1) // 2
    out = bytearray(len(raw))
    out[0::2] = raw[:half]
    out[1::2] = raw[half:]
    return bytes(out)


def read_exr(data):
    """(attributes, {channel: array of floats}) of a one-part scan-line EXR, compression none or zip."""
    if data[:4] != b'\x76\x2f\x31\x01' or data[4] != 2 or data[5] & 0x1a:
        raise AssertionError(f'not a one-part scan-line EXR: {data[:8]!r}')
    attributes, at = _exr_attributes(data)
    compression = attributes['compression'][1][0]
    lines_per_block = {0: 1, 2: 1, 3: 16}[compression]
    x0, y0, x1, y1 = struct.unpack('<4i', attributes['dataWindow'][1])
    width, height = x1 - x0 + 1, y1 - y0 + 1
    channels, rest = [], attributes['channels'][1]
    while rest[0] != 0:
        end = rest.index(b'\0')
        channels.append((rest[:end].decode(), struct.unpack_from('<i', rest, end + 1)[0]))
        rest = rest[end + 17:]
    widths = {1: 2, 2: 4}
    line_bytes = sum(widths[kind] for _, kind in channels) * width
    blocks = (height + lines_per_block - 1) // lines_per_block
    out = {name: array.array('f') for name, _ in channels}
    for offset in struct.unpack_from(f'<{blocks}Q', data, at):
        first, size = struct.unpack_from('<2i', data, offset)
        lines = min(lines_per_block, height - (first - y0))
        body = data[offset + 8:offset + 8 + size]
        body = body if compression == 0 else _exr_undo_zip(body, lines * line_bytes)
        at_line = 0
        for _ in range(lines):
            for name, kind in channels:
                piece = body[at_line:at_line + widths[kind] * width]
                out[name].extend(struct.unpack(f'<{width}{"e" if kind == 1 else "f"}', piece))
                at_line += widths[kind] * width
    return attributes, out


def exr_text(attributes, name):
    kind, value = attributes[name]
    if kind != 'string':
        raise AssertionError(f'EXR attribute {name} is of type {kind}, not string')
    return value.decode()


def read_png(data):
    """(width, height, channels, bytes) of an 8-bit PNG without interlace."""
    if data[:8] != b'\x89PNG\r\n\x1a\n':
        raise AssertionError(f'not a PNG: {data[:8]!r}')
    at, packed, head = 8, b'', None
    while at < len(data):
        size, kind = struct.unpack_from('>I4s', data, at)
        body = data[at + 8:at + 8 + size]
        if struct.unpack_from('>I', data, at + 8 + size)[0] != zlib.crc32(kind + body):
            raise AssertionError(f'PNG chunk {kind!r}: wrong checksum')
        if kind == b'IHDR':
            head = struct.unpack('>IIBBBBB', body)
        elif kind == b'IDAT':
            packed += body
        at += size + 12
    width, height, depth, colour, _, _, interlace = head
    channels = {0: 1, 2: 3, 4: 2, 6: 4}[colour]
    if depth != 8 or interlace:
        raise AssertionError(f'PNG of depth {depth}, interlace {interlace}')
    lines, stride = zlib.decompress(packed), width * channels
    out, above = bytearray(), bytearray(stride)
    for row in range(height):
        kind = lines[row * (stride + 1)]
        line = bytearray(lines[row * (stride + 1) + 1:(row + 1) * (stride + 1)])
        if kind == 1:
            for n in range(channels, stride):
                line[n] = (line[n] + line[n - channels]) & 255
        elif kind == 2:
            for n in range(stride):
                line[n] = (line[n] + above[n]) & 255
        elif kind == 3:
            for n in range(stride):
                line[n] = (line[n] + ((line[n - channels] if n >= channels else 0) + above[n]) // 2) & 255
        elif kind == 4:
            for n in range(stride):
                left, upper_left = (line[n - channels], above[n - channels]) if n >= channels else (0, 0)
                estimate = left + above[n] - upper_left
                by_distance = ((abs(estimate - left), 0, left), (abs(estimate - above[n]), 1, above[n]),
                               (abs(estimate - upper_left), 2, upper_left))
                line[n] = (line[n] + min(by_distance)[2]) & 255
        out += line
        above = line
    return width, height, channels, bytes(out)


def make_png(width, height, pixel):
    """An 8-bit grey PNG; pixel(column, row) -> 0..255."""
    lines = b''.join(b'\0' + bytes(pixel(column, row) for column in range(width)) for row in range(height))
    return png_around(width, height, zlib.compress(lines))


def png_around(width, height, packed_lines):
    """A grey PNG that declares this size, around already deflated lines."""
    def chunk(kind, body):
        return struct.pack('>I', len(body)) + kind + body + struct.pack('>I', zlib.crc32(kind + body))
    head = struct.pack('>IIBBBBB', width, height, 8, 0, 0, 0, 0)
    return b'\x89PNG\r\n\x1a\n' + chunk(b'IHDR', head) + chunk(b'IDAT', packed_lines) + chunk(b'IEND', b'')


def make_exr(width, height, value, claimed=None):
    """An uncompressed EXR with one float channel Y; value(column, row). `claimed`: (width, height) the header declares instead."""
    def attribute(name, kind, body):
        return name.encode() + b'\0' + kind.encode() + b'\0' + struct.pack('<i', len(body)) + body
    w, h = claimed or (width, height)
    box = struct.pack('<4i', 0, 0, w - 1, h - 1)
    channels = b'Y\0' + struct.pack('<iBBBBii', 2, 0, 0, 0, 0, 1, 1) + b'\0'
    head = b'\x76\x2f\x31\x01' + struct.pack('<i', 2) + attribute('channels', 'chlist', channels) + \
        attribute('compression', 'compression', b'\0') + attribute('dataWindow', 'box2i', box) + \
        attribute('displayWindow', 'box2i', box) + attribute('lineOrder', 'lineOrder', b'\0') + \
        attribute('pixelAspectRatio', 'float', struct.pack('<f', 1)) + \
        attribute('screenWindowCenter', 'v2f', struct.pack('<2f', 0, 0)) + \
        attribute('screenWindowWidth', 'float', struct.pack('<f', 1)) + b'\0'
    first = len(head) + 8 * height
    line = 8 + 4 * width
    table = struct.pack(f'<{height}Q', *(first + n * line for n in range(height)))
    body = b''.join(struct.pack('<2i', row, 4 * width) + struct.pack(f'<{width}f', *(value(c, row) for c in range(width)))
                    for row in range(height))
    return head + table + body


def sample_heights():
    """The sample's own integer heights, read without GDAL from the file that the VRT names."""
    with open(SAMPLE, encoding='utf-8') as vrt:
        text = vrt.read()
    archive, member = re.search(r'/vsizip/\{([^}]+)\}/([^<]+)<', text).groups()
    width, height = int(re.search(r'rasterXSize="(\d+)"', text)[1]), int(re.search(r'rasterYSize="(\d+)"', text)[1])
    offset = int(re.search(r'<ImageOffset>(\d+)<', text)[1])
    with zipfile.ZipFile(archive) as files:
        raw = files.read(member)[offset:]
    return Grid(width, height, struct.unpack(f'<{width * height}h', raw[:2 * width * height]))


# --- The CDF(2,2) analysis ---------------------------------------------------------------------------------------------

def _analysed(x):
    """Coarse samples of one line, amplitude normalisation, whole-sample mirror at both ends."""
    x = list(x)
    coarse_count = (len(x) + 1) // 2
    if len(x) % 2 == 0:
        x.append(x[-2])
    d = [x[n + 1] - (x[n] + x[n + 2]) * 0.5 for n in range(0, len(x) - 2, 2)]
    d = [d[0], *d, d[-1]]
    return [x[2 * n] + (d[n] + d[n + 1]) * 0.25 for n in range(coarse_count)]


def analysed(grid):
    """One analysis step of a whole terrain: the next coarser level."""
    rows = [_analysed(grid.row(row)) for row in range(grid.height)]
    columns = [_analysed(column) for column in zip(*rows)]
    values = [value for row in zip(*columns) for value in row]
    return Grid(len(columns), len(values) // len(columns), values)
