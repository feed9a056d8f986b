"""tf2_msgs, which no wheel has, made from its one-line definition by the generators of the other messages.

Where ROS is installed from apt, its own tf2_msgs is used, and nothing is made.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

DEFINITION = "geometry_msgs/TransformStamped[] transforms\n"
_NAME = "tf2_msgs"


@contextmanager
def made(folder: Path) -> Iterator[dict[str, str]]:
    """Make tf2_msgs in a folder, load it here, and yield what the environment of other processes needs.

    Skips the test where there is no compiler.
    """
    if importlib.util.find_spec(_NAME) is not None:
        yield {}
        return
    if shutil.which("gcc") is None or shutil.which("g++") is None:
        pytest.skip("no compiler makes tf2_msgs")
    pytest.importorskip("rosidl_generator_py")
    package = folder / _NAME
    _generate(folder)
    _compile(folder)
    (package / "__init__.py").touch()
    for one in ("generator_c", "typesupport_fastrtps_c", "typesupport_introspection_c", "typesupport_c"):
        ctypes.CDLL(str(package / f"lib{_NAME}__rosidl_{one}.so"), ctypes.RTLD_GLOBAL)
    sys.path.insert(0, str(folder))
    before = {name: os.environ.get(name, "") for name in ("PYTHONPATH", "LD_LIBRARY_PATH")}
    try:
        yield {
            "PYTHONPATH": os.pathsep.join([str(folder), *filter(None, [before["PYTHONPATH"]])]),
            "LD_LIBRARY_PATH": os.pathsep.join([str(package), *filter(None, [before["LD_LIBRARY_PATH"]])]),
        }
    finally:  # other tests are of a machine without it
        sys.path.remove(str(folder))
        for name in [one for one in sys.modules if one.partition(".")[0] == _NAME]:
            del sys.modules[name]


def _generate(folder: Path) -> None:
    from rosidl_adapter.msg import convert_msg_to_idl
    from rosidl_generator_c.cli import GenerateC
    from rosidl_generator_py.cli import GeneratePython
    from rosidl_generator_type_description.cli import HashTypeDescription
    from rosidl_typesupport_c.cli import GenerateCTypesupport
    from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
    from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport

    package, apart = folder / _NAME, folder / "introspection" / _NAME
    for one in (package, apart):
        (one / "msg").mkdir(parents=True)
    (package / "msg" / "TFMessage.msg").write_text(DEFINITION)
    convert_msg_to_idl(package, _NAME, Path("msg/TFMessage.msg"), package / "msg")
    share = Path(sys.prefix) / "share"
    given = (
        _NAME,
        [f"{package}:msg/TFMessage.idl"],
        [str(share / one) for one in ("geometry_msgs", "std_msgs", "builtin_interfaces")],
    )
    kinds = ["rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c"]
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("AMENT_PREFIX_PATH", sys.prefix)
        hashes = HashTypeDescription(_NAME).generate_type_hashes(*given, package)
        GenerateC(_NAME).generate(*given, package, type_description_files=[str(one) for one in hashes])
        GenerateFastRTPSCTypesupport(_NAME).generate(*given, package)
        GenerateIntrospectionCTypesupport(_NAME).generate(*given, apart)
        GenerateCTypesupport(_NAME, typesupport_implementations=kinds).generate(*given, package)
        GeneratePython(_NAME, typesupport_implementations=["rosidl_typesupport_c"]).generate(*given, package)


def _compile(folder: Path) -> None:
    import numpy as np

    prefix, package, detail = Path(sys.prefix), folder / _NAME, folder / _NAME / "msg" / "detail"
    headers = prefix / "include"
    include = [folder, folder / "introspection", headers, *headers.iterdir(), np.get_include()]
    flags = [f"-I{one}" for one in (*include, sysconfig.get_path("include"))]
    extension = f"{_NAME}_s__rosidl_typesupport_c{sysconfig.get_config_var('EXT_SUFFIX')}"
    libraries: list[tuple[str, list[Path], list[str]]] = [
        (
            f"lib{_NAME}__rosidl_generator_c.so",
            [detail / f"tf_message__{one}.c" for one in ("functions", "description", "type_support")],
            ["geometry_msgs__rosidl_generator_c", "rosidl_runtime_c", "rcutils"],
        ),
        (
            f"lib{_NAME}__rosidl_typesupport_fastrtps_c.so",
            [detail / "tf_message__type_support_c.cpp"],
            [
                f"{_NAME}__rosidl_generator_c",
                "geometry_msgs__rosidl_typesupport_fastrtps_c",
                "rosidl_typesupport_fastrtps_c",
                "fastcdr",
            ],
        ),
        (
            f"lib{_NAME}__rosidl_typesupport_introspection_c.so",
            [folder / "introspection" / _NAME / "msg" / "detail" / "tf_message__type_support.c"],
            [
                f"{_NAME}__rosidl_generator_c",
                "geometry_msgs__rosidl_typesupport_introspection_c",
                "rosidl_typesupport_introspection_c",
            ],
        ),
        (
            f"lib{_NAME}__rosidl_typesupport_c.so",
            [package / "msg" / "tf_message__type_support.cpp"],
            [f"{_NAME}__rosidl_generator_c", "rosidl_typesupport_c"],
        ),
        (
            extension,
            [package / "msg" / "_tf_message_s.c", package / f"_{_NAME}_s.ep.rosidl_typesupport_c.c"],
            [
                f"{_NAME}__rosidl_typesupport_c",
                f"{_NAME}__rosidl_generator_c",
                "geometry_msgs__rosidl_generator_py",
            ],
        ),
    ]
    for name, sources, needed in libraries:
        compiler = ["g++", "-std=c++17"] if sources[0].suffix == ".cpp" else ["gcc"]
        command = [*compiler, "-shared", "-fPIC", *flags, "-o", str(package / name), *map(str, sources)]
        command += [
            f"-L{prefix / 'lib'}",
            f"-L{package}",
            f"-Wl,-rpath,{prefix / 'lib'}",
            f"-Wl,-soname,{name}",
        ]
        done = subprocess.run(
            [*command, *(f"-l{one}" for one in needed)],
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
        )
        assert done.returncode == 0, done.stderr
