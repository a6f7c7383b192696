"""SpikingJelly's own importer reads what `to_nir` writes. Installs gigabytes: it needs a newer PyTorch than Debian's."""

import pathlib
import subprocess

from exported_populations import check_imported, exported_policies
from own_environment import python_with

IMPORTERS = pathlib.Path(__file__).parents[2] / "chips/importers.py"


def test_spikingjelly_imports_every_version(tmp_path):
    python = python_with("spikingjelly==2.0.0", "nir==1.0.8", "nirtorch==2.6")
    policies = exported_policies(tmp_path)
    subprocess.run([python, IMPORTERS, "spikingjelly", *policies], check=True)
    check_imported(policies, "spikingjelly")
