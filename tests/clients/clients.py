"""What the client tests share: npm packages, a layer to look at."""
import pathlib
import shutil
import subprocess
import sys

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / 'support'))


def install_packages():
    """The packages of package-lock.json; needs the npm registry the first time."""
    wanted = ('three', 'maplibre-gl', 'gltf-validator', '@here/quantized-mesh-decoder')
    if not all((HERE / 'node_modules' / name).is_dir() for name in wanted):
        subprocess.run([shutil.which('npm') or 'npm', 'ci', '--no-audit', '--no-fund', '--silent'], cwd=HERE, check=True)
