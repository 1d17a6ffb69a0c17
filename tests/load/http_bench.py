#!/usr/bin/env python3
"""Our HTTP server against nginx (2 workers, static files, sendfile) on this machine, in interleaved rounds of wrk.

usage: http_bench.py BUILD_DIR/http_bench_server [--rounds 5] [--seconds 3] [--only "64 KiB"] [--json FILE]
Needs nginx and wrk. Prints medians and ratios; exit 1 when a 64 or 264 KiB ratio of requests per second is under --least.
"""
import argparse
import json
import os
import pathlib
import re
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time

CASES = [("4 KiB", "/4/9/1/2.exr", None), ("64 KiB", "/64/9/1/2.exr", None), ("264 KiB", "/264/9/1/2.exr", None),
         ("304", "/64/9/1/2.exr", "etag")]
NGINX = """
worker_processes 2;
daemon off;
pid {dir}/pid;
error_log {dir}/error.log;
events {{ worker_connections 1024; multi_accept on; }}
http {{
  access_log off; sendfile on; tcp_nopush on; tcp_nodelay on; keepalive_requests 100000000;
  open_file_cache max=100; types {{ application/octet-stream exr; }}
  client_body_temp_path {dir}/b; proxy_temp_path {dir}/p; fastcgi_temp_path {dir}/f; uwsgi_temp_path {dir}/u; scgi_temp_path {dir}/s;
  server {{ listen 127.0.0.1:{port}; root {dir}/root; }}
}}
"""


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def etag_of(port, path):
    with socket.create_connection(("127.0.0.1", port)) as s:
        s.sendall(f"HEAD {path} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n".encode())
        answer = b"".join(iter(lambda: s.recv(65536), b"")).decode()
    return re.search(r"(?i)^etag: (.*?)\r$", answer, re.M).group(1)


def cpu_seconds(pid):
    """User and system time of a process and its children: what a request costs, however busy the machine is."""
    pids = [pid] + [int(p) for p in pathlib.Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    ticks = 0
    for one in pids:
        fields = pathlib.Path(f"/proc/{one}/stat").read_text().rsplit(")", 1)[1].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def wrk(port, path, seconds, etag, pid):
    command = ["wrk", "-t1", "-c64", f"-d{seconds}s", "--latency", f"http://127.0.0.1:{port}{path}"]
    if etag:
        command[1:1] = ["-H", f"If-None-Match: {etag}"]
    before = cpu_seconds(pid)
    text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    cpu = cpu_seconds(pid) - before
    if etag is None and "Non-2xx" in text or "Socket errors" in text:
        raise RuntimeError(text)
    scale = {"us": 1e-3, "ms": 1.0, "s": 1e3}

    def percentile(p):
        value, unit = re.search(rf"\s{p}%\s+([\d.]+)(us|ms|s)", text).groups()
        return float(value) * scale[unit]
    return {"rps": float(re.search(r"Requests/sec:\s+([\d.]+)", text).group(1)), "p50_ms": percentile(50), "p99_ms": percentile(99),
            "cpu_us": cpu * 1e6 / int(re.search(r"(\d+) requests in", text).group(1))}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("server")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=int, default=3)
    parser.add_argument("--least", type=float, default=0.9)
    parser.add_argument("--json")
    parser.add_argument("--only", help="one of: " + ", ".join(c[0] for c in CASES))
    args = parser.parse_args()
    for tool in ("nginx", "wrk"):
        if not shutil.which(tool, path="/usr/sbin:/usr/bin:/bin:/usr/local/bin"):
            sys.exit(f"{tool}: not installed")
    with tempfile.TemporaryDirectory() as name:
        directory = pathlib.Path(name)
        directory.chmod(0o755)
        for kib in (4, 64, 264):
            tile = directory / "root" / str(kib) / "9/1/2.exr"
            tile.parent.mkdir(parents=True)
            tile.write_bytes(b"t" * kib * 1024)
        ports = {"nginx": free_port()}
        config = directory / "nginx.conf"
        config.write_text(NGINX.format(dir=directory, port=ports["nginx"]))
        nginx = subprocess.Popen([shutil.which("nginx", path="/usr/sbin:/usr/bin"), "-c", str(config), "-p", name])
        ours = subprocess.Popen([args.server], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        try:
            ports["ours"] = int(ours.stdout.readline())
            time.sleep(0.5)
            pids = {"nginx": nginx.pid, "ours": ours.pid}
            report = {}
            for label, path, wants_etag in [c for c in CASES if args.only in (None, c[0])]:
                etags = {who: etag_of(port, path) if wants_etag else None for who, port in ports.items()}
                rows = {"ours": [], "nginx": []}
                for who in ("ours", "nginx"):  # one short round each to warm up
                    wrk(ports[who], path, 1, etags[who], pids[who])
                for turn in range(args.rounds):
                    for who in (("ours", "nginx"), ("nginx", "ours"))[turn % 2]:
                        rows[who].append(wrk(ports[who], path, args.seconds, etags[who], pids[who]))
                row = {}
                for key in ("rps", "p50_ms", "p99_ms", "cpu_us"):
                    ratios = [a[key] / b[key] for a, b in zip(rows["ours"], rows["nginx"])]
                    row[key] = {"ours": statistics.median(r[key] for r in rows["ours"]),
                                "nginx": statistics.median(r[key] for r in rows["nginx"]), "ratio": statistics.median(ratios)}
                report[label] = row
                print(f"{label:8s} " + "  ".join(f"{k}: {v['ours']:.5g} / {v['nginx']:.5g} = {v['ratio']:.2f}" for k, v in row.items()), flush=True)
        finally:
            ours.stdin.close()
            ours.wait(10)
            nginx.terminate()
            nginx.wait(10)
    if args.json:
        pathlib.Path(args.json).write_text(json.dumps(report, indent=1) + "\n")
    slow = [label for label in ("64 KiB", "264 KiB") if label in report and report[label]["rps"]["ratio"] < args.least]
    if slow:
        print(f"slower than {args.least} of nginx: {', '.join(slow)}")
    return 1 if slow else 0


if __name__ == "__main__":
    sys.exit(main())
