"""Resolve requirements/NAME.in with pip and write the exact versions of the whole closure to NAME.lock."""

import json
import re
import subprocess
import sys
from pathlib import Path


def normalised(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def main() -> None:
    folder = Path(__file__).resolve().parent
    source = folder / f"{sys.argv[1]}.in"
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    command += ["--dry-run", "--ignore-installed", "--report", "-", "--requirement", str(source)]
    report = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    found = [entry["metadata"] for entry in json.loads(report)["install"]]
    pins = sorted(f"{normalised(entry['name'])}=={entry['version']}" for entry in found)
    header = f"# Written by `make lock` from {source.name}; do not edit."
    source.with_suffix(".lock").write_text("\n".join([header, *pins]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
