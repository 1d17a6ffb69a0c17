#!/usr/bin/env python3
"""Ingest against GDAL on the same raster, and its memory on a very large one. Needs gdal-bin.

    tests/load/ingest_bench.py build/release/lodestone RASTER [--rounds 3] [--huge]

RASTER: for example ../shared/data/narok_large/narok_1.4arcsec.tif. --huge: a sparse 40,000 x 40,000 raster made here, the rest of it without data.
"""
import argparse
import os
import re
import resource
import statistics
import subprocess
import tempfile
import time


def timed(*command):
    """Seconds and peak resident MiB of a command."""
    began = time.monotonic()
    process = subprocess.Popen([str(c) for c in command], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if status != 0:
        raise RuntimeError(f'{command} ended with {status}')
    return time.monotonic() - began, usage.ru_maxrss / 1024


def against_gdal(program, raster, rounds):
    size = [int(n) for n in re.search(r'Size is (\d+), (\d+)', subprocess.run(['gdalinfo', raster], stdout=subprocess.PIPE, text=True, check=True).stdout).groups()]
    levels = []
    while max(size) >> (len(levels) + 1) >= 256:
        levels.append(str(2 ** (len(levels) + 1)))
    ours, theirs, peak = [], [], 0
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as folder:
            tif = os.path.join(folder, 'copy.tif')
            translate, _ = timed('gdal_translate', '-q', '-co', 'TILED=YES', '-co', 'COMPRESS=ZSTD', '-co', 'PREDICTOR=3', '-ot', 'Float32', raster, tif)
            overviews, _ = timed('gdaladdo', '-q', '-r', 'average', '--config', 'COMPRESS_OVERVIEW', 'ZSTD', '--config', 'PREDICTOR_OVERVIEW', '3', tif, *levels)
            theirs.append(translate + overviews)
            seconds, rss = timed(program, 'ingest', raster, '--layer', 'bench', '--data-dir', os.path.join(folder, 'data'))
            ours.append(seconds)
            peak = max(peak, rss)
    ratio = statistics.median(a / b for a, b in zip(ours, theirs))
    print(f'{size[0]} x {size[1]}: ingest {statistics.median(ours):.2f} s, GDAL {statistics.median(theirs):.2f} s, ratio {ratio:.2f} (goal 1.5), peak {peak:.0f} MiB (goal 512)')


def huge(program, raster):
    with tempfile.TemporaryDirectory() as folder:
        sparse = os.path.join(folder, 'sparse.vrt')
        # The raster's own pixels in the north-west corner of a canvas of 40,000 x 40,000, the rest without data.
        subprocess.run(['gdal_translate', '-q', '-of', 'VRT', '-srcwin', '0', '0', '40000', '40000', raster, sparse], check=True, stderr=subprocess.DEVNULL)
        seconds, rss = timed(program, 'ingest', sparse, '--layer', 'huge', '--nodata', '-9999', '--data-dir', os.path.join(folder, 'data'))
        print(f'40,000 x 40,000: {seconds:.1f} s, peak {rss:.0f} MiB (goal 512)')


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('program')
    parser.add_argument('raster')
    parser.add_argument('--rounds', type=int, default=3)
    parser.add_argument('--huge', action='store_true')
    arguments = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    print(f'load average {os.getloadavg()[0]:.1f}')
    against_gdal(os.path.abspath(arguments.program), os.path.abspath(arguments.raster), arguments.rounds)
    if arguments.huge:
        huge(os.path.abspath(arguments.program), os.path.abspath(arguments.raster))


if __name__ == '__main__':
    main()
