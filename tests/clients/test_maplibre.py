"""MapLibre GL draws our tiles as terrain: raster-dem source through tilejson.json, in a headless Chromium with software WebGL."""
import base64
import http.server
import json
import os
import pathlib
import shutil
import subprocess
import tempfile
import threading
import unittest
import urllib.parse

from clients import HERE, install_packages
import lodestone_daemon as ld

PLACE = (-84.25, 36.6)


class Pages(http.server.BaseHTTPRequestHandler):
    FILES = {'/': (HERE / 'maplibre.html', 'text/html'),
             '/maplibre-gl.js': (HERE / 'node_modules/maplibre-gl/dist/maplibre-gl.js', 'text/javascript'),
             '/maplibre-gl.css': (HERE / 'node_modules/maplibre-gl/dist/maplibre-gl.css', 'text/css')}

    def do_GET(self):
        path = urllib.parse.urlsplit(self.path).path
        if path not in self.FILES:
            return self.send_error(404)
        file, kind = self.FILES[path]
        body = file.read_bytes()
        self.send_response(200)
        self.send_header('Content-Type', kind)
        self.send_header('Content-Length', str(len(body)))
        self.end_headers()
        self.wfile.write(body)
        return None

    def do_POST(self):
        self.server.reports.append(json.loads(self.rfile.read(int(self.headers['Content-Length']))))
        self.server.reported.set()
        self.send_response(204)
        self.end_headers()

    def log_message(self, *_):
        pass


class MapLibre(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        install_packages()
        cls.folder = pathlib.Path(tempfile.mkdtemp(prefix='lodestone-maplibre-'))
        cls.addClassCleanup(shutil.rmtree, cls.folder, ignore_errors=True)
        data = str(cls.folder / 'data')
        done = ld.run('ingest', ld.SAMPLE, '--layer', 'hills', '--grid', 'WebMercatorQuad', '--data-dir', data)
        if done.returncode != 0:
            raise RuntimeError(done.stderr)
        cls.daemon = ld.Daemon(data)
        cls.addClassCleanup(cls.daemon.stop)
        cls.server = http.server.ThreadingHTTPServer(('127.0.0.1', 0), Pages)
        threading.Thread(target=cls.server.serve_forever, daemon=True).start()
        cls.addClassCleanup(cls.server.shutdown)

    def browse(self, encoding):
        """The page's last report, and its picture as PNG bytes."""
        self.server.reports = []
        self.server.reported = threading.Event()
        host, port = self.daemon.address[:2]
        settings = {'tilejson': f'http://{host}:{port}/tiles/hills/lsa/tilejson.json?encoding={encoding}', 'encoding': encoding, 'center': PLACE, 'zoom': 11.5}
        url = f'http://127.0.0.1:{self.server.server_address[1]}/#{urllib.parse.quote(json.dumps(settings))}'
        command = ['chromium', '--headless=new', '--no-sandbox', '--disable-dev-shm-usage', '--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader',
                   f'--user-data-dir={self.folder / ("profile-" + encoding)}', '--window-size=640,480', '--no-first-run', '--remote-debugging-port=0', url]
        browser = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            is_done = self.server.reported.wait(150)
        finally:
            browser.kill()
            browser.wait()
        self.assertTrue(is_done, f'the page never came to rest: {self.daemon.log()[-2000:]}')
        report = self.server.reports[-1]
        picture = base64.b64decode(report.pop('picture').split(',')[1])
        (pathlib.Path(os.environ.get('LODESTONE_PICTURES', self.folder)) / f'maplibre-{encoding}.png').write_bytes(picture)
        return report, picture

    def test_terrain_loads_and_stands_at_the_right_height(self):
        expected = self.daemon.get(f'/heights/hills/lsa?lon={PLACE[0]}&lat={PLACE[1]}').json()['height_m']
        for encoding in ('terrarium', 'mapbox'):
            report, picture = self.browse(encoding)
            self.assertEqual(report['errors'], [], report)
            self.assertTrue(report['loaded'], report)
            self.assertGreater(report['tiles'], 0, report)
            self.assertAlmostEqual(report['elevation'], expected, delta=30, msg=str(report))
            _, _, values = ld.read_png(picture)[1:4]
            self.assertGreater(len(set(bytes(values)[::997])), 20, 'the picture is empty')


if __name__ == '__main__':
    unittest.main()
