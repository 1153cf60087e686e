"""Build products by libxsmm and oneDNN (docs/products.md), where they and g++ are; else nothing."""

import re
import shutil
import subprocess
import sys
import sysconfig
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FOLDER = "src/pacesetter/learner"
COMPILE = ("g++", "-std=c++20", "-O2", "-w", "-shared", "-fPIC", "-Wl,--exclude-libs,ALL")
# Where pip puts headers and libraries, such as oneDNN's.
PIP = (f"-I{sys.prefix}/include", f"-L{sys.prefix}/lib")


class Source(NamedTuple):
    """A file of C++, what it becomes, the header that must be there, and what it is linked with."""

    source: str
    built: str
    header: str
    libraries: tuple[str, ...]


SOURCES = (
    Source(
        f"{FOLDER}/products.cc",
        f"{FOLDER}/libproducts.so",
        "libxsmm.h",
        ("-lxsmm", "-lxsmmnoblas", "-ldl", "-lm", "-lpthread"),
    ),
    Source(
        f"{FOLDER}/bfloat16.cc",
        f"{FOLDER}/libbfloat16.so",
        "oneapi/dnnl/dnnl.hpp",
        (*PIP, "-fopenmp", "-ldnnl"),
    ),
)


class BuildHook(BuildHookInterface):
    """Never fails an install: pacesetter works without, more slowly."""

    def dependencies(self) -> list[str]:
        """jaxlib for its headers, if there is anything to build with."""
        return ["jaxlib>=0.10"] if any(map(can_link, SOURCES)) else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if self.target_name != "wheel":
            return
        built = [each.built for each in SOURCES if build(Path(self.root), each)]
        build_data["artifacts"] += built
        if built:
            # Nothing in them knows Python, so one wheel serves every version of it.
            platform = re.sub("[-.]", "_", sysconfig.get_platform())
            build_data.update(pure_python=False, tag=f"py3-none-{platform}")


def can_link(source: Source) -> bool:
    """Whether g++ and the library are there."""
    if not shutil.which("g++"):
        return False
    words = [*COMPILE, "-o", "/dev/null", "-xc++", "-", "-xnone", *source.libraries]
    line = f"#include <{source.header}>\n"
    return subprocess.run(words, input=line, text=True, capture_output=True).returncode == 0


def build(root: Path, source: Source) -> bool:
    """Compile into the source tree; what stood there before goes in any case."""
    (root / source.built).unlink(missing_ok=True)
    spec = find_spec("jaxlib")
    if spec is None or spec.origin is None or not can_link(source):
        return False
    headers = Path(spec.origin).with_name("include")
    made, given = str(root / source.built), str(root / source.source)
    words = [*COMPILE, f"-I{headers}", "-o", made, given, *source.libraries]
    tried = subprocess.run(words, text=True, capture_output=True)
    print(tried.stderr, file=sys.stderr)
    return tried.returncode == 0
