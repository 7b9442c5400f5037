"""Environment with the product installed as by `pip install .`, in a second and without a network.

The packages are copied as pyproject.toml says of the wheel, so nothing comes from the checkout.
The dependencies are those of the environment that runs the tests.
"""

import shutil
import site
import sys
import tomllib
from pathlib import Path

from tests.support.paths import ROOT

# without the environment
PYTHON = Path(sys._base_executable).resolve()  # type: ignore[attr-defined]
DEPENDENCIES = Path(site.getsitepackages()[0])


def install_into(
    prefix: Path,
    *,
    seen_at: Path | None = None,
    python: Path = PYTHON,
    dependencies: Path = DEPENDENCIES,
) -> None:
    """Make `prefix` an environment.

    `seen_at`, `python` and `dependencies` are the paths as the programs see them.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
    packages = prefix / "lib" / version / "site-packages"
    packages.mkdir(parents=True)
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    for name in wheel["packages"]:  # its links are followed, as by the wheel's builder
        shutil.copytree(ROOT / name, packages / Path(name).name)
    (packages / "dependencies.pth").write_text(f"{dependencies}\n")

    (prefix / "pyvenv.cfg").write_text(
        f"home = {python.parent}\ninclude-system-site-packages = false\n"
    )
    programs = prefix / "bin"
    programs.mkdir()
    (programs / "python").symlink_to(python)
    for name, target in project["project"]["scripts"].items():
        module, function = target.split(":")
        path = programs / name
        interpreter = (seen_at or prefix) / "bin" / "python"
        path.write_text(
            f"#!{interpreter}\nimport sys\nfrom {module} import "
            f"{function}\nsys.exit({function}())\n"
        )
        path.chmod(0o755)
