"""The Khronos glTF validator and HERE's quantized-mesh decoder read what the codec tests write."""
import os
import pathlib
import subprocess
import tempfile
import unittest

from clients import install_packages

HERE = pathlib.Path(__file__).resolve().parent
PROGRAMS = pathlib.Path(os.environ.get("LODESTONE_BIN", HERE.parents[1] / "build/dev/lodestone")).resolve().parent / "tests"


class MeshReaders(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        install_packages()

    def check(self, kind, program, variable, expected_files):
        with tempfile.TemporaryDirectory() as folder:
            written = subprocess.run([PROGRAMS / program, "--gtest_filter=*EveryOptionSet*:*EveryExtensionSet*", "--gtest_brief=1"],
                                     env={**os.environ, variable: folder}, capture_output=True, text=True)
            self.assertEqual(written.returncode, 0, written.stdout)
            self.assertEqual(len(list(pathlib.Path(folder).glob("*." + kind))), expected_files)
            read = subprocess.run(["node", HERE / "check_meshes.mjs", kind, folder], capture_output=True, text=True)
            self.assertEqual(read.returncode, 0, read.stdout[-4000:] + read.stderr[-2000:])

    def test_the_khronos_validator_has_nothing_to_say(self):
        self.check("glb", "storage_glb_test", "LODESTONE_GLB_OUT", 96)

    def test_heres_decoder_sees_the_same_terrain(self):
        self.check("terrain", "storage_quantized_mesh_test", "LODESTONE_TERRAIN_OUT", 24)


if __name__ == "__main__":
    unittest.main()
