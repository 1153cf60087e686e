"""Build the products by libxsmm (docs/products.md) where g++ and libxsmm are; else nothing."""

import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

SOURCE = "src/pacesetter/learner/products.cc"
BUILT = "src/pacesetter/learner/libproducts.so"
COMPILE = ("g++", "-std=c++20", "-O2", "-w", "-shared", "-fPIC", "-Wl,--exclude-libs,ALL")
LIBRARIES = ("-lxsmm", "-lxsmmnoblas", "-ldl", "-lm", "-lpthread")


class BuildHook(BuildHookInterface):
    """Never fails an install: pacesetter works without, more slowly."""

    def dependencies(self) -> list[str]:
        """jaxlib for its headers, if there is anything to build with."""
        return ["jaxlib>=0.10"] if can_link() else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if self.target_name == "wheel" and build(Path(self.root)):
            build_data["artifacts"].append(BUILT)
            build_data.update(pure_python=False, infer_tag=True)


def can_link() -> bool:
    """Whether g++ and libxsmm are there."""
    if not shutil.which("g++"):
        return False
    words = ["g++", "-shared", "-o", "/dev/null", "-xc++", "-", "-xnone", *LIBRARIES]
    tried = subprocess.run(words, input="#include <libxsmm.h>\n", text=True, capture_output=True)
    return tried.returncode == 0


def build(root: Path) -> bool:
    """Compile into the source tree; what stood there before goes in any case."""
    (root / BUILT).unlink(missing_ok=True)
    spec = find_spec("jaxlib")
    if spec is None or spec.origin is None or not can_link():
        return False
    headers = Path(spec.origin).with_name("include")
    words = [*COMPILE, f"-I{headers}", "-o", str(root / BUILT), str(root / SOURCE), *LIBRARIES]
    tried = subprocess.run(words, text=True, capture_output=True)
    print(tried.stderr, file=sys.stderr)
    return tried.returncode == 0
