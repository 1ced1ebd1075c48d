"""YAML files people write by hand: validated with pydantic, every error with file and line."""

import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args

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
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(f"cannot read {path}: {error}") from error
    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        content = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError) as error:  # ValueError: a date such as 2026-99-99
        raise FileError(_not_yaml(path, error)) from error
    _refuse_repeated_keys(path, root)
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise FileError("; ".join(_problem(path, root, model, problem) for problem in error.errors()[:3])) from error


def _not_yaml(path: Path, error: Exception) -> str:
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        return f"{path}:{error.problem_mark.line + 1}: not YAML: {error.problem}"
    return f"{path}: not YAML: {' '.join(str(error).split())}"


def _refuse_repeated_keys(path: Path, root: yaml.Node | None) -> None:
    """YAML forbids them, PyYAML silently takes the last one."""
    nodes, known = [root], set()  # an alias leads to a node again, even to one around it
    while nodes:
        node = nodes.pop()
        if id(node) in known:
            continue
        known.add(id(node))
        if isinstance(node, yaml.SequenceNode):
            nodes += node.value
        elif isinstance(node, yaml.MappingNode):
            keys = set()
            for key, value in node.value:
                if key.value in keys:
                    raise FileError(f"{path}:{key.start_mark.line + 1}: the key {key.value} stands there twice")
                keys.add(key.value)
                nodes.append(value)


def _problem(path: Path, root: yaml.Node | None, model: type[BaseModel], problem: object) -> str:
    assert isinstance(problem, dict)
    location = problem["loc"]
    place = ".".join(map(str, _without_kinds(root, location, last=problem["type"] != "missing"))) or "top level"
    found = problem.get("input")
    shown = "" if isinstance(found, dict | list) or found is None else f" (found {found!r})"
    text = problem["msg"].removeprefix("Value error, ")
    if problem["type"] == "extra_forbidden":
        text, shown = f"unknown key; expected one of {', '.join(_keys(model, location))}", ""
    elif problem["type"] == "missing":
        text = "this key is missing"
    elif problem["type"] == "model_type":
        text = f"expected a mapping with the keys {', '.join(_keys(model, (*location, '')))}"
    elif problem["type"] in ("union_tag_not_found", "model_attributes_type"):
        text = "expected a mapping with the key kind"
    elif problem["type"] == "union_tag_invalid":
        tags = [tag.strip(" '") for tag in problem["ctx"]["expected_tags"].split(",")]
        near = difflib.get_close_matches(problem["ctx"]["tag"], tags, 3)
        hint = f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(tags)}"
        text, shown = f"there is no kind {problem['ctx']['tag']!r}; {hint}", ""
    return f"{path}:{_line(root, location)}: {place}: {text}{shown}"


def _without_kinds(node: yaml.Node | None, location: Sequence[object], *, last: bool) -> list[object]:
    """The location as the file has it: a pydantic union puts the chosen kind in between, or `last`."""
    kept: list[object] = []
    for number, part in enumerate(location):
        entries = {pair[0].value: pair[1] for pair in node.value} if isinstance(node, yaml.MappingNode) else {}
        if isinstance(node, yaml.MappingNode) and part not in entries and (last or number < len(location) - 1):
            continue
        kept.append(part)
        if isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
            node = node.value[part]
        else:
            node = entries.get(part) if isinstance(part, str) else None
    return kept


def _keys(model: type[BaseModel], location: Sequence[object]) -> list[str]:
    """The keys that may stand beside the last part of `location`."""
    models = [model]
    for part in location[:-1]:
        fields = [each.model_fields[part] for each in models if isinstance(part, str) and part in each.model_fields]
        if fields:
            models = [found for field in fields for found in _models(field.annotation)]
        elif isinstance(part, str):  # a pydantic union puts the chosen kind into the location
            kinds = [each for each in models if any(field.default == part for field in each.model_fields.values())]
            models = kinds or models
    return list(dict.fromkeys(key for each in models for key in each.model_fields))


def _models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for argument in get_args(annotation) for found in _models(argument)]


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
