"""Clients that are slow, many or gone: the others are served all the same, and everything is given back."""

import contextlib
import pathlib
import resource
import select
import shutil
import socket
import struct
import tempfile
import threading
import time
import unittest

import rig

HEADER_S = 3
WRITE_S = 3


class HostileClientTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 20000), hard))
        cls.folder = pathlib.Path(tempfile.mkdtemp(prefix="lodestone-hostile-"))
        cls.addClassCleanup(shutil.rmtree, cls.folder)
        cls.data = cls.folder / "data"
        rig.ingest(cls.data, rig.SAMPLE_DEM, "hills")

    def setUp(self):
        self.open = []
        self.addCleanup(lambda: [s.close() for s in self.open])

    def serve(self, *flags):
        daemon = rig.Daemon(self.data, "--disk-cache-mib", 0, "--header-timeout-s", HEADER_S, "--write-timeout-s", WRITE_S, *flags)
        self.addCleanup(daemon.kill)
        daemon.get("/tiles/hills/lsa/2/1/1.f32")
        return daemon

    def connect(self, daemon, receive_buffer=None):
        client = socket.socket()
        if receive_buffer:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        client.settimeout(10)
        client.connect(daemon.address)
        self.open.append(client)
        return client

    def served_s(self, daemon, seed):
        """Time of a tile from memory, then of a fresh one."""
        times = []
        for path in ("/tiles/hills/lsa/2/1/1.f32", f"/tiles/hills/lsa/4/3/3.f32?seed={seed}"):
            began = time.monotonic()
            reply = daemon.get(path, timeout=10)
            times.append(time.monotonic() - began)
            self.assertEqual(reply.status, 200)
        return max(times)

    def await_true(self, condition, what, limit_s=12):
        deadline = time.monotonic() + limit_s
        while not condition():
            self.assertLess(time.monotonic(), deadline, what)
            time.sleep(0.1)

    def test_slow_headers(self):
        """1,000 connections that send their header a byte at a time."""
        daemon = self.serve()
        files, before = daemon.open_files(), daemon.metric("http_timeouts_total")
        clients = [self.connect(daemon) for _ in range(1000)]
        text = b"GET / HTTP/1.1\r\nHost: slow\r\nX-Filler: " + b"a" * 200
        began = time.monotonic()
        worst_s, at = 0, 0
        while time.monotonic() - began < HEADER_S + 1.5:
            for client in clients:
                with contextlib.suppress(OSError):
                    client.send(text[at:at + 1])
            at += 1
            worst_s = max(worst_s, self.served_s(daemon, at))
            time.sleep(0.2)
        self.assertLess(worst_s, 1.0)
        self.await_true(lambda: daemon.open_files() <= files + 5, "slow headers keep their connections")
        self.assertGreaterEqual(daemon.metric("http_timeouts_total") - before, 1000)
        for client in clients[::50]:
            client.settimeout(5)
            with contextlib.suppress(ConnectionResetError, BrokenPipeError):
                said = client.recv(4096)
                self.assertTrue(said == b"" or b" 408 " in said, said[:100])

    def test_slow_bodies(self):
        """100 uploads that stop after their first byte."""
        daemon = self.serve()
        for _ in range(100):
            self.connect(daemon).send(b"POST /heights/hills/lsa HTTP/1.1\r\nHost: slow\r\nContent-Type: application/json\r\nContent-Length: 5000\r\n\r\n{")
        for turn in range(5):
            self.assertLess(self.served_s(daemon, 1000 + turn), 1.0)

    def test_slow_readers(self):
        """300 clients that ask for 16 tiles each and read nothing."""
        daemon = self.serve()
        files, memory_mib = daemon.open_files(), daemon.resident_mib()
        clients = [self.connect(daemon, receive_buffer=4096) for _ in range(300)]
        for number, client in enumerate(clients):
            client.send(b"".join(b"GET /tiles/hills/lsa/3/%d/%d.f32 HTTP/1.1\r\nHost: slow\r\n\r\n" % (number % 6, n % 5) for n in range(16)))
        worst_s, most_mib = 0, 0
        for turn in range(8):
            worst_s = max(worst_s, self.served_s(daemon, turn))
            most_mib = max(most_mib, daemon.resident_mib())
            time.sleep(0.2)
        self.assertLess(worst_s, 1.0)
        self.assertLess(most_mib - memory_mib, 300)
        self.await_true(lambda: daemon.open_files() <= files + 5, "slow readers keep their connections", limit_s=20)
        self.assertGreaterEqual(daemon.metric("http_timeouts_total"), 290)

    def test_more_connections_than_allowed(self):
        """Half-open connections by the thousand: those over the limit are refused, one that is at work is not."""
        daemon = self.serve("--max-connections", 300)
        worker = self.connect(daemon)
        flood = [self.connect(daemon) for _ in range(1500)]
        for client in flood[::2]:
            with contextlib.suppress(OSError):
                client.send(b"GET /ti")
        for _ in range(5):
            worker.sendall(b"GET /healthz HTTP/1.1\r\nHost: a\r\n\r\n")
            self.assertIn(b" 200 ", worker.recv(4096))
        # Who comes now is told so, or turned away; never left waiting.
        late = self.connect(daemon)
        with contextlib.suppress(ConnectionResetError, BrokenPipeError):
            late.sendall(b"GET /healthz HTTP/1.1\r\nHost: a\r\n\r\n")
            said = late.recv(4096)
            self.assertTrue(said == b"" or b" 503 " in said, said[:200])
        self.await_true(lambda: self.is_served(daemon), "the flood holds the daemon beyond the header timeout")
        self.assertGreater(daemon.metric("connections_refused_total"), 1000)
        self.assertEqual(daemon.stop(), 0)

    def is_served(self, daemon):
        with contextlib.suppress(OSError, Exception):
            return daemon.get("/healthz", timeout=2).status == 200
        return False

    def test_flood_of_leaving_clients(self):
        """Requests whose clients reset the connection at once: no leak, no crash, cold tiles are dropped."""
        daemon = self.serve()
        files = daemon.open_files()
        reset = struct.pack("ii", 1, 0)

        def flood(part):
            for n in range(400):
                client = socket.socket()
                client.settimeout(10)
                client.connect(daemon.address)
                client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, reset)
                client.send(b"GET /tiles/hills/lsa/6/%d/%d.exr?seed=%d HTTP/1.1\r\nHost: a\r\n\r\n" % (n % 40, n % 30, n + 1000 * part))
                if n % 3 == 0:
                    select.select([client], [], [], 0.005)
                client.close()

        threads = [threading.Thread(target=flood, args=(part,)) for part in range(4)]
        for thread in threads:
            thread.start()
        worst_s = 0
        while any(thread.is_alive() for thread in threads):
            worst_s = max(worst_s, self.served_s(daemon, time.monotonic_ns() % 10**6))
        for thread in threads:
            thread.join()
        self.assertLess(worst_s, 5.0)
        self.await_true(lambda: daemon.open_files() <= files + 5, "left connections stay open")
        self.await_true(lambda: daemon.metric("queue_tiles") == 0 and daemon.metric("running_tiles") == 0, "work for nobody goes on")
        self.assertEqual(daemon.stop(), 0)

    def test_half_closed_connections(self):
        """Clients that shut down their sending side still get their answer."""
        daemon = self.serve()
        clients = []
        for n in range(200):
            client = self.connect(daemon)
            client.sendall(b"GET /tiles/hills/lsa/2/1/1.f32 HTTP/1.1\r\nHost: a\r\nConnection: close\r\n\r\n")
            client.shutdown(socket.SHUT_WR)
            clients.append(client)
        for client in clients:
            received = b""
            while piece := client.recv(1 << 16):
                received += piece
            self.assertIn(b" 200 ", received[:20])
            self.assertEqual(len(received.split(b"\r\n\r\n", 1)[1]), 4 * 257 * 257)

    def test_idle_connections(self):
        """3,000 idle ones cost little and are closed in the end."""
        daemon = self.serve("--idle-timeout-s", 2, "--max-connections", 6000)
        files, memory_mib = daemon.open_files(), daemon.resident_mib()
        for _ in range(3000):
            self.connect(daemon)
        self.await_true(lambda: daemon.open_files() >= files + 2900, "the connections were not taken")
        self.assertLess(self.served_s(daemon, 1), 0.5)
        self.assertLess(daemon.resident_mib() - memory_mib, 100)
        self.await_true(lambda: daemon.open_files() <= files + 5, "idle connections are kept")


if __name__ == "__main__":
    unittest.main()
