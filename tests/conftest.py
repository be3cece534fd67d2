"""What all tests share: one thread per matrix product, system packages, measured recordings of other rigs."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

# Before anything imports NumPy: its library reads these once.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

from twin.station.doctor import find_browser, find_software_vulkan  # noqa: E402


def find_ngspice() -> Path | None:
    found = shutil.which("ngspice")
    return Path(found) if found else None


# The same examples at every run where a failure must mean a change; new ones on a developer's machine.
settings.register_profile("repeatable", derandomize=True)
if os.environ.get("CI"):
    settings.load_profile("repeatable")

DEBIAN_PACKAGES = {
    "chromium": find_browser,
    "mesa-vulkan-drivers": find_software_vulkan,
    "ngspice": find_ngspice,
}


@pytest.fixture(scope="session")
def requires_debian() -> Callable[[str], Path]:
    """``requires_debian("chromium")`` is the path of what that package brings.

    Where it is missing the test is skipped on a user's machine and fails where ``CI`` is set: there, a test
    that quietly stops running is worse than one that fails.
    """

    def require(package: str) -> Path:
        found = DEBIAN_PACKAGES[package]()
        if found is None:
            reason = f"needs the system package {package} (Debian and Ubuntu: apt install {package})"
            if os.environ.get("CI"):
                pytest.fail(reason)
            pytest.skip(reason)
        return found

    return require


@pytest.fixture(scope="session")
def realdata() -> Path:
    """Folder of other people's recordings, beside the checkout; they are no part of the project."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "realdata"
    if not folder.is_dir():
        pytest.skip(f"no recordings of other rigs at {folder}")
    return folder
