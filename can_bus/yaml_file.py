"""YAML files people write by hand: validated with pydantic, every error with file and line."""

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import yaml
from pydantic import BaseModel, ValidationError

Model = TypeVar("Model", bound=BaseModel)


class FileError(ValueError):
    """A file that cannot be read or says something wrong; the text has file, line and what was expected."""


def load(path: Path, model: type[Model]) -> Model:
    """Read a YAML file into a pydantic model.

    Raises:
        FileError: the file is missing, is not YAML, or does not fit the model.
    """
    try:
        text = path.read_text(encoding="utf-8")
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        content = yaml.safe_load(text)
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(f"cannot read {path}: {error}") from error
    except yaml.YAMLError as error:
        raise FileError(f"{path}: not YAML: {' '.join(str(error).split())}") from error
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise FileError("; ".join(_problem(path, root, problem) for problem in error.errors()[:3])) from error


def _problem(path: Path, root: yaml.Node | None, problem: object) -> str:
    assert isinstance(problem, dict)
    place = ".".join(str(part) for part in problem["loc"]) or "top level"
    found = problem.get("input")
    shown = "" if isinstance(found, dict | list) or found is None else f" (found {found!r})"
    return f"{path}:{_line(root, problem['loc'])}: {place}: {problem['msg']}{shown}"


def _line(node: yaml.Node | None, location: Sequence[object]) -> int:
    """The line of the deepest part of `location` that the file has."""
    line = 1
    for part in location:
        if node is None:
            break
        line = node.start_mark.line + 1
        if isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
            node = node.value[part]
        elif isinstance(node, yaml.MappingNode):
            entry = next((pair for pair in node.value if pair[0].value == part), None)
            if entry is None:  # a pydantic union puts the chosen kind into the location
                continue
            line = entry[0].start_mark.line + 1
            node = entry[1]
        else:
            break
    return node.start_mark.line + 1 if node is not None and not isinstance(node, yaml.ScalarNode) else line
