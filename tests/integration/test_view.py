"""POST /view over HTTP: answers, paths, prefetch, and errors that name their field."""
import json
import os
import subprocess
import tempfile
import unittest
import urllib.error
import urllib.request

BIN = os.environ['LODESTONE_BIN']
SAMPLE = os.path.join(os.path.dirname(__file__), '..', '..', 'config', 'jacksboro.vrt')
CAMERA = {'eye': [-84.25, 36.6, 1500], 'target': [-84.2, 36.55, 500]}


class ViewTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.directory = tempfile.TemporaryDirectory()
        data = cls.directory.name
        subprocess.run([BIN, 'ingest', SAMPLE, '--layer', 'hills', '--data-dir', data], check=True, stdout=subprocess.DEVNULL)
        cls.daemon = subprocess.Popen([BIN, 'serve', '--data-dir', data, '--listen', '127.0.0.1:0', '--admin-listen', '127.0.0.1:0'],
                                      stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        for line in cls.daemon.stdout:
            if line.startswith('listening on '):
                cls.url = line.split()[-1].rstrip('/')
                break

    @classmethod
    def tearDownClass(cls):
        cls.daemon.terminate()
        cls.daemon.wait(30)
        cls.daemon.stdout.close()
        cls.directory.cleanup()

    def view(self, body, recipe='lsa'):
        text = body if isinstance(body, str) else json.dumps(body)
        request = urllib.request.Request(f'{self.url}/view/hills/{recipe}', text.encode(), method='POST')
        try:
            with urllib.request.urlopen(request) as reply:
                return reply.status, json.load(reply)
        except urllib.error.HTTPError as error:
            with error:
                self.assertEqual(error.headers['Content-Type'], 'application/problem+json')
                return error.code, json.load(error)

    def test_a_camera_gets_tiles_that_exist(self):
        for recipe in ('linear', 'lsa', 'gsa', 'square-square', 'diamond-square', 'fractal-wavelet'):
            status, answer = self.view(CAMERA, recipe)
            self.assertEqual(status, 200, answer)
            self.assertGreater(len(answer['tiles']), 10)
            self.assertGreater(answer['culled']['frustum'], 0)
            self.assertGreater(answer['visible_ground_m2'], 1e6)
            for tile in answer['tiles']:
                self.assertLessEqual(tile['error_px'], 2)
            tile = answer['tiles'][0]
            with urllib.request.urlopen(f"{self.url}/tiles/hills/{recipe}/{tile['z']}/{tile['x']}/{tile['y']}.f32") as reply:
                self.assertEqual(len(reply.read()), 257 * 257 * 4)

    def test_a_path_gives_the_list_of_its_answers(self):
        status, one = self.view(CAMERA)
        self.assertEqual(status, 200)
        status, many = self.view({'path': [CAMERA, {'eye': CAMERA['eye'], 'direction': [0, 0, 1]}], 'prefetch': True})
        self.assertEqual(status, 200)
        self.assertEqual(many[0], one)
        self.assertEqual(many[1]['tiles'], [])

    def test_a_geographic_layer_in_its_own_coordinates_is_the_same_view(self):
        status, answer = self.view({**CAMERA, 'crs': 'layer'})
        self.assertEqual(status, 200)
        other = self.view(CAMERA)[1]
        # WGS 84 to WGS 84 may still move a distance by its last bits.
        self.assertEqual([(t['z'], t['x'], t['y']) for t in answer['tiles']], [(t['z'], t['x'], t['y']) for t in other['tiles']])

    def test_bad_input_is_refused_and_named(self):
        for body, word in (({}, 'eye'), ({**CAMERA, 'eye': [1, 2]}, 'eye'), ({**CAMERA, 'eye': [-84.25, 36.6, -100]}, 'inside the ground'),
                           ({**CAMERA, 'target': CAMERA['eye']}, 'target'), ({**CAMERA, 'fov_y_deg': 0}, 'fov_y_deg'),
                           ({**CAMERA, 'viewport': [0, 5]}, 'viewport'), ({**CAMERA, 'max_error_px': -1}, 'max_error_px'),
                           ({**CAMERA, 'seed': -1}, 'seed'), ({**CAMERA, 'balanced': 1}, 'balanced'), ({**CAMERA, 'nose': 1}, 'nose'),
                           ({'path': [CAMERA, {'eye': 3, 'target': [0, 0, 0]}]}, 'path[1].eye'), ('{"eye": [NaN, 1, 1]}', 'NaN')):
            status, problem = self.view(body)
            self.assertEqual(status, 400, body)
            self.assertIn(word, problem['detail'])
        self.assertEqual(self.view(CAMERA, 'no-such')[0], 404)
        self.assertEqual(self.view('x' * 70000)[0], 413)


if __name__ == '__main__':
    unittest.main()
