"""Hashes by rosidl itself: ``rosidl_judge.py DEFINITIONS OUTPUT`` prints them as JSON.

DEFINITIONS has a folder for each package, with its files as ROS installs them.
"""

from __future__ import annotations

import json
import re
import sys
from graphlib import TopologicalSorter
from pathlib import Path

from rosidl_adapter import convert_to_idl
from rosidl_generator_type_description import generate_type_hash

DEFINITIONS, OUTPUT = (Path(word).absolute() for word in sys.argv[1:])
IMPLIED = {
    "srv": {"service_msgs", "builtin_interfaces"},
    "action": {"service_msgs", "builtin_interfaces", "unique_identifier_msgs", "action_msgs"},
}
"""Packages that the parts of services and actions refer to."""


def needed(package: Path) -> set[str]:
    """Return the other packages that a package refers to."""
    found: set[str] = set()
    for path in package.glob("*/*"):
        code = re.sub(r"#.*", "", path.read_text())
        found |= set(re.findall(r"^\s*(\w+)/\w+", code, re.M)) | IMPLIED.get(
            path.parent.name, set()
        )
    return found - {package.name}


def judged(package: Path, others: list[str]) -> dict[str, str]:
    """Return the hashes of a package's types, by name."""
    output, hashes = OUTPUT / package.name, {}
    (output / "idl").mkdir(parents=True)
    tuples = []
    for path in sorted(package.glob("*/*")):
        inside = path.relative_to(package)
        convert_to_idl(package, package.name, inside, output / "idl")
        tuples.append(f"{output / 'idl'}:{inside.with_suffix('.idl')}")
    arguments = {
        "package_name": package.name,
        "output_dir": str(output),
        "idl_tuples": tuples,
        "include_paths": [f"{name}:{OUTPUT / name}" for name in others],
    }
    (output / "arguments.json").write_text(json.dumps(arguments))
    generate_type_hash(str(output / "arguments.json"))
    for path in output.glob("*/*.json"):
        for entry in json.loads(path.read_text())["type_hashes"]:
            hashes[entry["type_name"]] = entry["hash_string"]
    return hashes


packages = {path.name: needed(path) for path in DEFINITIONS.iterdir()}
found: dict[str, str] = {}
done: list[str] = []
for name in TopologicalSorter(packages).static_order():
    found |= judged(DEFINITIONS / name, done)
    done.append(name)
print(json.dumps(found))
