"""What the fault tests share: the program under test, data directories, tiny rasters, damage to files."""

import hashlib
import http.client
import os
import pathlib
import random
import re
import shutil
import struct
import tempfile
import threading
import time
import zlib

import lodestone_daemon

PROGRAM = lodestone_daemon.program()
SAMPLE_DEM = lodestone_daemon.SAMPLE
lodestone = lodestone_daemon.run


def ingest(data_dir, source, layer, *flags):
    """Ingests and insists that it works."""
    result = lodestone("ingest", source, "--layer", layer, "--data-dir", data_dir, *flags)
    if result.returncode != 0:
        raise AssertionError(f"ingest of {source} failed with {result.returncode}: {result.stderr}")


def came_from(reply):
    """memory, disk or miss."""
    return re.search(r"desc=(\w+)", reply.header("server-timing")).group(1)


class Daemon(lodestone_daemon.Daemon):
    """On the plain C++ twin unless told otherwise (device="": the OpenCL device): it starts at once."""

    def __init__(self, data_dir, *flags, device="host", env=None):
        began = time.monotonic()
        super().__init__(str(data_dir), "--device", device, *map(str, flags), env=env)
        self.start_s = time.monotonic() - began

    def metric(self, name):
        """Sum over labels."""
        values = [v for k, v in self.metrics().items() if re.fullmatch(rf"lodestone_{name}(\{{.*\}})?", k)]
        if not values:
            raise AssertionError(f"/metrics has no {name}")
        return sum(values)

    def open_files(self):
        return len(os.listdir(f"/proc/{self.process.pid}/fd"))

    def resident_mib(self):
        status = pathlib.Path(f"/proc/{self.process.pid}/status").read_text()
        return int(re.search(r"VmRSS:\s+(\d+)", status).group(1)) / 1024

    def is_alive(self):
        return self.process.poll() is None


class Oracle:
    """Right bytes: a daemon of its own on an undamaged copy, without a disk cache."""

    def __init__(self, data_dir):
        self.copy = pathlib.Path(tempfile.mkdtemp(prefix="lodestone-oracle-"))
        shutil.copytree(pathlib.Path(data_dir) / "layers", self.copy / "data" / "layers")
        self.daemon = Daemon(self.copy / "data", "--disk-cache-mib", 0)
        self.known = {}

    def digest(self, path):
        if path not in self.known:
            reply = self.daemon.get(path)
            if reply.status != 200:
                raise AssertionError(f"oracle: {path} gave {reply.status}: {reply.body[:300]}")
            self.known[path] = digest(reply.body)
        return self.known[path]

    def close(self):
        self.daemon.kill()
        shutil.rmtree(self.copy)


def digest(data):
    return hashlib.sha256(data).hexdigest()


def flip_bit(path, offset, bit):
    with open(path, "r+b") as file:
        file.seek(offset)
        byte = file.read(1)[0]
        file.seek(offset)
        file.write(bytes([byte ^ (1 << bit)]))


def flip_random_bit(rng, path):
    offset = rng.randrange(os.path.getsize(path))
    flip_bit(path, offset, rng.randrange(8))
    return offset


def tree_bytes(directory):
    return sum(p.stat().st_blocks * 512 for p in pathlib.Path(directory).rglob("*") if p.is_file())


def write_geotiff(path, width, height, heights=None, *, tile=None, compress=True, shared_tile=False, declared=None):
    """Int16 GeoTIFF in UTM 17N. Either strips of all rows, or tiles; shared_tile: every tile is the same stored bytes.

    declared: (width, height) to claim instead.
    """
    compression = 8 if compress else 1
    pack = (lambda raw: zlib.compress(raw, 6)) if compress else (lambda raw: raw)
    claimed_w, claimed_h = declared or (width, height)
    if tile:
        count = -(-claimed_w // tile) * -(-claimed_h // tile)
        blocks = [pack(bytes(2 * tile * tile))]
        if not shared_tile:
            raise ValueError("tiles are only written shared")
    else:
        rng = random.Random(7)
        heights = heights or [500 + (x * y) % 97 + rng.randrange(20) for y in range(height) for x in range(width)]
        count = 1
        blocks = [pack(struct.pack(f"<{width * height}h", *heights))]
    entries = [(256, 4, 1, claimed_w), (257, 4, 1, claimed_h), (258, 3, 1, 16), (259, 3, 1, compression), (262, 3, 1, 1), (277, 3, 1, 1), (339, 3, 1, 2)]
    scale = struct.pack("<3d", 30, 30, 0)
    tie = struct.pack("<6d", 0, 0, 0, 500000, 4000000, 0)
    keys = struct.pack("<16H", 1, 1, 0, 3, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 32617)
    first_block = 8
    body = b"".join(blocks)
    offsets = struct.pack("<I", first_block) * count
    sizes = struct.pack("<I", len(blocks[0])) * count
    extra_at = 8 + len(body) + len(body) % 2
    extra = b""

    def place(tag, kind, number, raw):
        nonlocal extra
        if len(raw) <= 4:
            entries.append((tag, kind, number, int.from_bytes(raw.ljust(4, b"\0"), "little")))
        else:
            entries.append((tag, kind, number, extra_at + len(extra)))
            extra += raw + b"\0" * (len(raw) % 2)

    if tile:
        entries += [(322, 4, 1, tile), (323, 4, 1, tile)]
        place(324, 4, count, offsets)
        place(325, 4, count, sizes)
    else:
        place(273, 4, count, offsets)
        entries.append((278, 4, 1, claimed_h))
        place(279, 4, count, sizes)
    place(33550, 12, 3, scale)
    place(33922, 12, 6, tie)
    place(34735, 3, 16, keys)
    entries.sort()
    directory_at = extra_at + len(extra)
    directory = struct.pack("<H", len(entries)) + b"".join(struct.pack("<HHII", *e) for e in entries) + bytes(4)
    pathlib.Path(path).write_bytes(b"II*\0" + struct.pack("<I", directory_at) + body + bytes(len(body) % 2) + extra + directory)


class Load:
    """Clients that ask for `paths` in turn until stopped; a broken connection is no failure (the daemon gets killed)."""

    def __init__(self, daemon, paths, clients=4):
        self.daemon = daemon
        self.replies = []  # (path, status, digest)
        self.is_stopping = False
        self.lock = threading.Lock()
        self.paths = iter(paths)
        self.threads = [threading.Thread(target=self.run) for _ in range(clients)]
        for thread in self.threads:
            thread.start()

    def run(self):
        while not self.is_stopping:
            with self.lock:
                path = next(self.paths, None)
            if path is None:
                return
            try:
                reply = self.daemon.get(path, timeout=20)
            except (OSError, http.client.HTTPException):
                continue
            with self.lock:
                self.replies.append((path, reply.status, digest(reply.body)))

    def stop(self):
        self.is_stopping = True
        for thread in self.threads:
            thread.join()
