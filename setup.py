"""Build description of the ament_python package; colcon and pip both read it."""

import platform
import sys
from pathlib import Path

from setuptools import Extension, find_packages, setup

NAME = "rim_camera_ros"

# The one place for minimum versions; requirements/oldest.in pins them for `make test-oldest`.
# package.xml names the same libraries by their rosdep keys, which carry no versions.
MINIMUM = [
    "numpy>=1.26",
    "scipy>=1.11",
    "PyYAML>=6.0.1",
    "matplotlib>=3.6",
    "jinja2>=3.1",
    "rosbags>=0.10.9",
    "argcomplete>=3.1",
    # For pip alone. In a ROS workspace rosdep installs apt's python3-opencv, which pip knows by no name;
    # colcon installs no requirements, and what it installs does not look for them.
    "opencv-python-headless>=4.6",
]
# pictures and pages, by the name that messages give: both are required anyway
REPORTS = ["matplotlib>=3.6", "jinja2>=3.1"]
# closed forms of unknown curves
DIAGNOSIS = ["scikit-learn>=1.3"]
# more recordings than one machine
CLUSTER = ["distributed>=2024.1"]
# finding and resetting SwissRanger cameras
USB = ["pyusb>=1.2"]
# tests_require is gone since setuptools 72; colcon finds pytest in this extra.
TEST = ["pytest>=7.4", "pytest-timeout", "hypothesis>=6.98", "psutil"]

# Without a compiler numpy computes the same (rim_camera_ros/pipeline/kernels.py). It is no module: ctypes
# loads it, so that Python's headers are not needed. The last options leave NaN and sums as they are written.
KERNELS = Extension(
    f"{NAME}.pipeline._kernels",
    [f"{NAME}/pipeline/kernels.c"],
    extra_compile_args=[
        *("-std=c11", "-O3", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"),
        *(["-mprefer-vector-width=512"] if platform.machine() == "x86_64" else []),
    ],
    optional=True,
)


def shared(*folders: str) -> list[tuple[str, list[str]]]:
    """Every file below the folders, for share/rim_camera_ros with the same relative path."""
    found: dict[str, list[str]] = {}
    for folder in folders:
        for path in sorted(Path(folder).rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts and not path.name.startswith("."):
                found.setdefault(f"share/{NAME}/{path.parent.as_posix()}", []).append(path.as_posix())
    return sorted(found.items())


# colcon puts executables where `ros2 run` looks; a wheel (pip) puts rim on the PATH by itself
ON_PATH = [] if {"bdist_wheel", "editable_wheel"} & set(sys.argv) else [("bin", ["scripts/rim"])]

setup(
    name=NAME,
    version="0.1.0",
    description="Range imaging cameras in ROS 2: driver, simulator, correction, calibration and diagnosis",
    maintainer="rim_camera_ros maintainers",
    maintainer_email="maintainers@example.org",
    license="Apache-2.0",
    python_requires=">=3.12",
    ext_modules=[KERNELS],
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={
        NAME: [
            f"**/*.{kind}"
            for kind in ("c", "typed", "css", "html", "js", "json", "npy", "rules", "svg", "xml", "yaml")
        ]
    },
    # colcon installs these; an editable installation does not, and reads them from the source tree
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *shared("launch", "config", "calibration"),
        *ON_PATH,
    ],
    install_requires=MINIMUM,
    extras_require={
        "reports": REPORTS,
        "diagnosis": DIAGNOSIS,
        "cluster": CLUSTER,
        "usb": USB,
        "test": TEST,
    },
    zip_safe=False,
    entry_points={
        "console_scripts": [
            f"camera_node = {NAME}.nodes.camera_node:main",
            f"driver_node = {NAME}.nodes.driver.node:main",
            f"correction_node = {NAME}.nodes.correction.node:main",
            f"people_node = {NAME}.nodes.people.node:main",
            f"calibration_node = {NAME}.nodes.calibration.node:main",
            f"rim = {NAME}.cli:main",
        ],
        # The group "rim_camera_ros.effects" belongs to other packages: they add physical effects through it.
    },
)
