"""The page /viewer/ in a headless browser that can reach nothing but the daemon: it must draw ground."""
import os
import re
import subprocess
import sys
import tempfile
import unittest
import urllib.request

sys.path.insert(0, os.path.join(os.path.dirname(__file__), '..', 'support'))
from lodestone_daemon import read_png  # noqa: E402

BIN = os.environ['LODESTONE_BIN']
SAMPLE = os.path.join(os.path.dirname(__file__), '..', '..', 'config', 'jacksboro.vrt')


class ViewerTest(unittest.TestCase):
    def setUp(self):
        self.directory = tempfile.TemporaryDirectory()
        data = self.directory.name + '/data'
        subprocess.run([BIN, 'ingest', SAMPLE, '--layer', 'hills', '--data-dir', data], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self.daemon = subprocess.Popen([BIN, 'serve', '--data-dir', data, '--listen', '127.0.0.1:0', '--admin-listen', '127.0.0.1:0'],
                                       stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        for line in self.daemon.stdout:
            if line.startswith('listening on '):
                self.url = line.split()[-1].rstrip('/')
                break

    def tearDown(self):
        self.daemon.terminate()
        self.daemon.wait(30)
        self.daemon.stdout.close()
        self.directory.cleanup()

    def test_the_page_names_no_other_host(self):
        with urllib.request.urlopen(self.url + '/viewer/') as reply:
            self.assertEqual(reply.headers['Content-Security-Policy'], "default-src 'self'")
            page = reply.read().decode()
        self.assertNotRegex(page, r'https?://')
        for name in re.findall(r'(?:src|href)="([^"]+)"', page) + ['vendor/three.module.min.js']:
            with urllib.request.urlopen(f'{self.url}/viewer/{name}') as reply:
                self.assertEqual(reply.status, 200)

    def test_the_canvas_shows_ground(self):
        picture = self.directory.name + '/page.png'
        subprocess.run(['chromium', '--headless=new', '--no-sandbox', '--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader',
                        '--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1', '--window-size=800,600', f'--user-data-dir={self.directory.name}/browser',
                        '--virtual-time-budget=20000', f'--screenshot={picture}', self.url + '/viewer/?step=8&error=8&recipe=linear'],
                       check=True, timeout=180, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        with open(picture, 'rb') as file:
            width, height, channels, pixels = read_png(file.read())
        # Right of the panel: sky above, ground of many colours below.
        colours, ground = set(), 0
        for y in range(height // 2, height, 3):
            for x in range(width // 3, width, 3):
                at = (y * width + x) * channels
                pixel = tuple(pixels[at:at + 3])
                colours.add(pixel)
                ground += pixel[2] < pixel[1]
        samples = len(range(height // 2, height, 3)) * len(range(width // 3, width, 3))
        self.assertGreater(len(colours), 100)
        self.assertGreater(ground, samples // 2)


if __name__ == '__main__':
    unittest.main()
