"""The reference of the library, from its docstrings: ``python -m waldnet.api_reference docs/reference/api.md``."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Iterator
from enum import Enum
from pathlib import Path
from textwrap import dedent, fill
from types import ModuleType
from typing import Any

from pydantic import BaseModel

import waldnet
from waldnet import estimation

_HEAD = """# The library

All names of `import waldnet` and of `waldnet.estimation`. This page is made from the docstrings, by
`python -m waldnet.api_reference docs/reference/api.md`.
"""
_WIDTH = 116
#: Sections of a docstring whose lines are entries ``name: text``.
_ENTRIES = {"Args": "Arguments", "Attributes": "Attributes", "Raises": "Raises", "Warns": "Warns"}
_TEXTS = ("Returns", "Yields", "References")
#: Classes that users get and do not make.
_UNCALLED = BaseException | Enum | BaseModel


def make_reference() -> str:
    """The page, as Markdown."""
    return "\n".join([_HEAD, *_module(waldnet), *_module(estimation)])


def _module(module: ModuleType) -> Iterator[str]:
    yield f"## {module.__name__}\n"
    yield from _docstring(inspect.getdoc(module) or "")
    for name in sorted(module.__all__, key=str.lower):
        value = getattr(module, name)
        if not inspect.ismodule(value):
            yield f"### {module.__name__}.{name}\n"
            yield from _value(name, value)


def _value(name: str, value: Any) -> Iterator[str]:
    """What is said of a name."""
    if inspect.isclass(value):
        if not issubclass(value, _UNCALLED) and not getattr(value, "_is_protocol", False):
            yield from _signature(name, value)
        yield from _docstring(inspect.getdoc(value) or "")
        if issubclass(value, Enum):
            yield "Values: " + ", ".join(f"`{member.name}` = {member.value}" for member in value) + ".\n"
        for part, member in sorted(vars(value).items()):
            if not part.startswith(("_", "model_")):
                yield from _member(name, part, member)
    elif callable(value):
        yield from _signature(name, value)
        yield from _docstring(inspect.getdoc(value) or "")
    else:
        yield f"`{value!r}`\n"
        yield from _paragraphs((inspect.getdoc(type(value)) or "").partition("\n")[0])


def _member(owner: str, name: str, member: Any) -> Iterator[str]:
    """A property or method of a class."""
    function = getattr(member, "__func__", member)
    if isinstance(member, property):
        yield f"#### {owner}.{name}\n"
        yield from _docstring(inspect.getdoc(member) or "")
    elif inspect.isfunction(function):
        yield f"#### {owner}.{name}()\n"
        yield from _signature(f"{owner}.{name}", function)
        yield from _docstring(inspect.getdoc(function) or "")


def _signature(name: str, value: Callable[..., Any]) -> Iterator[str]:
    """How it is called: on one line where that fits, else with one argument a line."""
    signature = inspect.signature(value)
    first = next(iter(signature.parameters), "")
    if first in ("self", "cls") and not inspect.isclass(value):
        signature = signature.replace(parameters=list(signature.parameters.values())[1:])
    if inspect.isclass(value):
        signature = signature.replace(return_annotation=inspect.Signature.empty)
    # Annotations are texts; without the quotes, and without the modules that names come from.
    text = re.sub(r"ForwardRef\('([^']*)'\)", r"\1", str(signature))
    text = re.sub(r"<function (\w+) at \w+>", r"\1", text)
    text = re.sub(r"\b(?:waldnet|numpy|collections|pathlib|typing)(?:\.\w+)*\.(?=\w)", "", text)
    text = re.sub(r"(?<=: |> )'([^']*)'|(?<=: |> )\"([^\"]*)\"", lambda found: found[1] or found[2], text)
    if len(name + text) > _WIDTH:
        inner, _, returned = text[1:].rpartition(")")
        text = "(\n" + "".join(f"    {part},\n" for part in _split(inner)) + f"){returned}"
    yield f"```python\n{name}{text}\n```\n"


def _split(arguments: str) -> Iterator[str]:
    """Arguments one by one: commas within brackets part none."""
    depth, start = 0, 0
    for at, sign in enumerate(arguments):
        depth += (sign in "([{") - (sign in ")]}")
        if sign == "," and not depth:
            yield arguments[start:at].strip()
            start = at + 1
    yield arguments[start:].strip()


def _docstring(text: str) -> Iterator[str]:
    """A docstring of Google's style as Markdown."""
    parts = re.split(rf"^({'|'.join((*_ENTRIES, *_TEXTS))}):\n", text.strip() + "\n", flags=re.MULTILINE)
    yield from _paragraphs(parts[0])
    for title, body in zip(parts[1::2], parts[2::2], strict=True):
        lines = dedent(body).strip()
        if title in _TEXTS:
            yield fill(f"**{title}** {_inline(' '.join(lines.split()))}", _WIDTH, **_UNBROKEN) + "\n"
        else:
            entries = re.split(r"\n(?=\S)", lines)
            yield f"**{_ENTRIES[title]}**\n"
            yield "\n".join(_entry(entry) for entry in entries) + "\n"


_UNBROKEN: Any = {"break_long_words": False, "break_on_hyphens": False}


def _entry(text: str) -> str:
    name, colon, rest = " ".join(text.split()).partition(": ")
    return fill(f"- `{name}`{colon}{_inline(rest)}", _WIDTH, subsequent_indent="  ", **_UNBROKEN)


def _paragraphs(text: str) -> Iterator[str]:
    """Paragraphs and lists as they are; what is indented, such as formulas, in blocks."""
    for paragraph in re.split(r"\n{2,}", text.strip()):
        if paragraph.startswith("    "):
            yield "```text\n" + dedent(paragraph).rstrip() + "\n```\n"
        else:
            yield _inline(paragraph.rstrip(":") + ":" if paragraph.endswith("::") else paragraph) + "\n"


def _inline(text: str) -> str:
    """Code as Markdown has it; brackets of units are no links."""
    return text.replace("``", "`")


def main(path: str = "docs/reference/api.md") -> None:
    """Write the page."""
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(make_reference(), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
