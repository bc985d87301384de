"""Regenerate the figures of a document: every command it names is run, and what it prints takes its place.

    python -m waldnet.benchmarks.figures docs/performance.md [WORD ...]

A place begins with the line ``<!-- figures: COMMAND -->`` and ends with ``<!-- end -->``. With words, only commands
that contain one of them are run.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

_PLACE = re.compile(r"(<!-- figures: (?P<command>.+?) -->\n).*?(<!-- end -->)", re.DOTALL)


def main() -> None:
    """Rewrite the document that the command line names."""
    document, words = Path(sys.argv[1]), sys.argv[2:]
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}

    def regenerated(place: re.Match[str]) -> str:
        command = place["command"]
        if words and not any(word in command for word in words):
            return place[0]
        print(command, flush=True)
        done = subprocess.run(shlex.split(command), stdout=subprocess.PIPE, text=True, check=True, env=environment)
        return f"{place[1]}\n{done.stdout.strip()}\n\n{place[3]}"

    document.write_text(_PLACE.sub(regenerated, document.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
