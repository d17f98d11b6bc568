"""Strict loading of YAML files into frozen dataclasses.

An unknown key, a missing key, a wrong type or an invalid value raises a ConfigError of one
sentence, which names the place, the value and what is allowed. The range of a field is part of its
annotation, beside its unit and its meaning:

    m_b: Annotated[Positive, "kg", "sprung mass"]

Configurations are looked up by name in the packaged folder, or read from a path:
`load(VehicleParameters, "vehicles", "land_rover_defender_110")`, `load(..., "my_car.yaml")`.
"""

import dataclasses
import difflib
import json
import math
import pickle
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, cast, get_args, get_origin

import yaml
from pydantic import AfterValidator, Discriminator, Field, Tag, TypeAdapter, ValidationError

from road_envs.core.reading import parsing, regular

T = TypeVar("T")

# `__pydantic_config__` of every configuration dataclass
STRICT = {"extra": "forbid", "arbitrary_types_allowed": True}
Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, lt=1)]
Count = Annotated[int, Field(ge=1)]

MAX_FILE_SIZE = 2**22  # largest YAML file [bytes]
MAX_VALUES = 10**6  # most values in a YAML file, every alias counted as what it stands for
MAX_SHOWN = 200  # characters of a value that a message repeats
UNKNOWN_KEY = "unexpected_keyword_argument"  # pydantic's type of this error

_validator = cache(TypeAdapter)


class ConfigError(ValueError):
    """Invalid input. The message is one sentence that names the value and the valid choices."""


class UnknownKeyError(ConfigError, TypeError):
    """Unknown key or keyword argument: a TypeError as well, as Python raises for unknown ones."""


class Settings:
    """Base class of dataclasses of settings.

    `build` and direct construction check the ranges of the annotations. A subclass adds rules
    between its fields in `__post_init__`, after `super().__post_init__()`.
    """

    __pydantic_config__ = STRICT

    def __post_init__(self) -> None:
        # pydantic checks in `build` only, not in calls of the class nor in dataclasses.replace
        for name, adapter in _range_adapters(cast(Any, type(self))).items():
            try:
                adapter.validate_python(getattr(self, name), strict=True)
            except ValidationError as error:
                errors = [{**e, "loc": (name, *e["loc"])} for e in error.errors()]
                raise ConfigError(_describe(errors, type(self))) from None


def _check_order(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] > pair[1]:
        raise ValueError(f"must be the smallest and the largest value, got {pair}")
    return pair


SmallestFirst = AfterValidator(_check_order)  # constraint on a pair of numbers


def by_kind(default: str) -> Discriminator:
    """Chooser of one dataclass of a union of tagged ones by the key or field `kind`, if given."""

    def kind(value: Any) -> str:
        if isinstance(value, Mapping):
            return str(value.get("kind", default))
        return str(getattr(value, "kind", default))

    return Discriminator(kind)


def folder() -> Path:
    """Return the folder of the shipped configurations, in a checkout or in an installed wheel."""
    here = Path(__file__).parents[1]
    packaged = here / "configs"
    return packaged if packaged.is_dir() else here.parent / "configs"


def names(kind: str) -> list[str]:
    """Return the names of the shipped configurations of a kind, such as "vehicles" or "roads"."""
    return sorted(f.stem for f in (folder() / kind).glob("*.yaml"))


def validate_choice(what: str, given: object, known: Mapping[str, Any] | list[str]) -> str:
    """Return `given` if it is among `known`; else raise a ConfigError: unknown `what`, choices."""
    if isinstance(given, str) and given in known:
        return given
    close = difflib.get_close_matches(str(given), list(known), n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    raise ConfigError(f"unknown {what} {shown(given)}{hint}; known: {', '.join(sorted(known))}")


class _Strict:
    """Part of a YAML loader that bounds what aliases expand to, and rejects duplicate keys."""

    def get_single_node(self) -> yaml.Node | None:
        node = super().get_single_node()  # type: ignore[misc]
        if (size := _expanded_size(node, {})) > MAX_VALUES:
            raise ConfigError(f"{size:.3g} values with all aliases; at most {MAX_VALUES} are read")
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: dict[Any, int] = {}
        keys = [key for key, _ in node.value] if isinstance(node, yaml.MappingNode) else []
        for key in (key for key in keys if isinstance(key, yaml.ScalarNode)):
            name, line = (key.tag, key.value), key.start_mark.line + 1
            if name in seen:
                lines = f"{seen[name]} and {line}"
                raise ConfigError(f"the key {key.value!r} is duplicated, in lines {lines}")
            seen[name] = line
        return super().construct_mapping(node, deep)  # type: ignore[misc]


class _Loader(_Strict, yaml.SafeLoader):
    """Loader of any file; it refuses deep nesting by Python's limit of recursion."""


class _ShippedLoader(_Strict, getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Loader of the shipped files, ten times as fast, by libyaml where PyYAML has it."""


def _expanded_size(node: Any, known: dict[int, float]) -> float:
    """Number of values of a node, aliases counted each time; infinite for a cycle."""
    if isinstance(node, tuple):
        return sum(_expanded_size(part, known) for part in node)
    if id(node) not in known:
        known[id(node)] = math.inf
        parts = node.value if isinstance(node, yaml.CollectionNode) else ()
        known[id(node)] = 1 + sum(_expanded_size(part, known) for part in parts)
    return known[id(node)]


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the mapping in a YAML file. Raises ConfigError if unreadable or not a mapping."""
    with parsing(path, ConfigError, "not valid YAML"):
        if (size := path.stat().st_size) > MAX_FILE_SIZE:
            raise ConfigError(f"{size} bytes; at most {MAX_FILE_SIZE} are read")
        shipped = path.is_relative_to(folder())
        data = pickle.loads(_parse(regular(path).read_text(encoding="utf-8"), shipped))
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: expected a mapping of keys to values, got {_type_name(data)}")
    return data


@lru_cache(maxsize=256)
def _parse(text: str, shipped: bool) -> bytes:
    """Content of a YAML text, pickled: each caller gets its own copy. Reading takes up to 10 ms."""
    return pickle.dumps(yaml.load(text, Loader=_ShippedLoader if shipped else _Loader))


def find(kind: str, name: str | Path) -> Path:
    """Return the file of a shipped configuration, or `name` itself if it is a YAML path."""
    path = Path(name)
    if path.suffix in (".yaml", ".yml"):
        return path
    stem = validate_choice(kind.removesuffix("s"), str(name), names(kind))
    return folder() / kind / f"{stem}.yaml"


def load(cls: type[T], kind: str, name: str | Path) -> T:
    """Load a configuration by shipped name or by path. Raises ConfigError."""
    path = find(kind, name)
    return build(cls, read_yaml(path), str(path))


def build(cls: type[T], data: Mapping[str, Any], where: str) -> T:
    """Build a frozen dataclass from a mapping. Raises ConfigError prefixed by `where`."""
    try:
        # JSON mode converts lists to tuples but keeps "16e-6", which YAML reads as a string
        text = json.dumps(data, default=str)
    except TypeError:  # a date as a key
        raise ConfigError(f"{where}: a key must be text or a number") from None
    except (ValueError, RecursionError) as error:  # a cycle
        raise ConfigError(f"{where}: {error}") from None
    try:
        return _adapter(cast(Any, cls)).validate_json(text, strict=True)
    except ValidationError as error:
        unknown = any(one["type"] == UNKNOWN_KEY for one in error.errors())
        kind = UnknownKeyError if unknown else ConfigError
        raise kind(f"{where}: {_describe(error.errors(), cls)}") from None
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


@cache
def _adapter(cls: Any) -> TypeAdapter:
    if not hasattr(cls, "__pydantic_config__"):  # of another package: what it learns are arrays
        cls.__pydantic_config__ = STRICT
    return TypeAdapter(cls)


@cache
def _range_adapters(cls: Any) -> dict[str, TypeAdapter]:
    """A validator of each field whose annotation has constraints."""
    hints: dict[str, Any] = {f.name: f.type for f in dataclasses.fields(cls)}
    return {name: _validator(_unnoted(h)) for name, h in hints.items() if _is_constrained(h)}


def _unnoted(hint: Any) -> Any:
    """Return a type without unit and meaning: fields of one range then share a validator."""
    if get_origin(hint) is not Annotated:
        return hint
    rules = [note for note in hint.__metadata__ if not isinstance(note, str)]
    return Annotated[(hint.__origin__, *rules)] if rules else hint.__origin__


def _is_constrained(hint: Any) -> bool:
    own = any(not isinstance(note, str) for note in getattr(hint, "__metadata__", ()))
    return own or any(map(_is_constrained, get_args(hint)))


def _describe(errors: Sequence[Mapping[str, Any]], cls: type) -> str:
    """Return one sentence for the first error; the other errors are only counted."""

    # unknown keys first: a misspelt key also causes a "missing" error; then values of the right
    # type, because a union also reports that they are not of its other types
    def rank(error: Mapping[str, Any]) -> tuple[bool, bool]:
        kind = error["type"]
        return kind != UNKNOWN_KEY, kind != "value_error" and not _range_of(error)

    first = min(errors, key=rank)
    places = {_field_of(error, cls)[1] for error in errors}
    (hint, loc, notes), value = _field_of(first, cls), first["input"]
    if first["type"] == UNKNOWN_KEY:
        owner = _bare(hint)
        fields = dataclasses.fields(owner) if dataclasses.is_dataclass(owner) else ()
        known = sorted(f.name for f in fields if f.init)
        close = difflib.get_close_matches(loc[-1], known, n=1)
        text = f"unknown key{f', did you mean {close[0]!r}' if close else ''}"
        text += f"; known: {', '.join(known)}"
    elif first["type"] == "missing":
        text = "missing"
    elif first["type"] == "union_tag_invalid":
        kind, known = (first["ctx"][key] for key in ("tag", "expected_tags"))
        text = f"unknown kind {shown(kind)}; known: {known.replace(chr(39), '')}"
    elif first["type"] == "value_error":
        text = str(first["ctx"]["error"])
    elif allowed := _range_of(first):
        unit, meaning, *_ = *notes, "", ""
        text = f"must {allowed}, got {shown(value)}{unit and f' {unit}'}"
        text += meaning and f" ({meaning})"
    else:
        text = f"{_expected(first)}, got {shown(value)} ({_type_name(value)})"
    at = ".".join(map(str, loc))
    more = f" (and {len(places) - 1} more)" if len(places) > 1 else ""
    return (f"{at}: {text}" if at else text) + more


# kinds of YAML values in plain words, by the names that Python and Pydantic have for them
YAML_KINDS = dict(bool="true or false", float="a number", int="a whole number", NoneType="nothing")
YAML_KINDS |= dict.fromkeys(("dataclass", "dict"), "a mapping of keys to values")
YAML_KINDS |= dict.fromkeys(("list", "tuple"), "a list")
YAML_KINDS |= dict.fromkeys(("str", "string"), "text")


def _expected(error: Mapping[str, Any]) -> str:
    """Requirement on a value, in the words of a YAML file instead of Pydantic's."""
    if error["type"] == "literal_error":
        return f"must be {error['ctx']['expected']}"
    expected = YAML_KINDS.get(error["type"].partition("_")[0])
    return f"must be {expected}" if expected else "is of a wrong kind"


def _range_of(error: Mapping[str, Any]) -> str:
    """The range that a value is outside of; empty if the error is another one."""
    match error["type"], error.get("ctx"):
        case "finite_number", _:
            return "be finite"
        case "greater_than", {"gt": limit}:
            return f"be above {limit:g}" if limit else "be positive"
        case "greater_than_equal", {"ge": limit}:
            return f"be at least {limit:g}" if limit else "not be negative"
        case "less_than", {"lt": limit}:
            return f"be below {limit:g}"
        case "less_than_equal", {"le": limit}:
            return f"be at most {limit:g}"
        case "too_long", {"max_length": limit}:
            return f"have at most {limit} elements"
        case "too_short", {"min_length": limit}:
            return f"have at least {limit} element" + "s" * (limit > 1)
    return ""


def _field_of(error: Mapping[str, Any], cls: type) -> tuple[Any, tuple[Any, ...], list[str]]:
    """The annotation of what is wrong, its place, and the unit and meaning of its field.

    The place has the fields, keys and indices of the error's location, not branches of unions.
    """
    hint: Any = cls
    place: tuple[Any, ...] = ()
    notes: list[str] = []
    for part in error["loc"]:
        if (branch := _tagged(hint).get(part)) is not None:
            hint = branch
            continue
        owner = _bare(hint)
        types: dict[Any, Any] = {}
        if dataclasses.is_dataclass(owner):
            types = {f.name: f.type for f in dataclasses.fields(owner)}
        elif get_origin(owner) is dict or isinstance(part, int):
            types = {part: (*get_args(owner), None)[0 if isinstance(part, int) else 1]}
        if part in types:
            hint, place = types[part], (*place, part)
            notes = [x for x in getattr(hint, "__metadata__", ()) if isinstance(x, str)] or notes
    if error["type"] == UNKNOWN_KEY:
        place = (*place, error["loc"][-1])
    return hint, place, notes


def _tagged(hint: Any) -> dict[Any, Any]:
    """Branches of a union by their tags; empty if the type is none of tagged ones."""
    while get_origin(hint) is Annotated:
        hint = get_args(hint)[0]
    tags = [(note, b) for b in _branches(hint) for note in getattr(b, "__metadata__", ())]
    return {note.tag: branch for note, branch in tags if isinstance(note, Tag)}


def _bare(hint: Any) -> Any:
    """A type without annotations; of a union its dataclass, or else its first type."""
    if get_origin(hint) is Annotated:
        return _bare(get_args(hint)[0])
    types = [_bare(branch) for branch in _branches(hint)] or [hint]
    return next(filter(dataclasses.is_dataclass, types), types[0])


def _branches(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else ()


def shown(value: object) -> str:
    """Return a value as Python code, without the middle of a long one."""
    text = repr(value)
    return text if len(text) <= MAX_SHOWN else f"{text[: MAX_SHOWN - 10]} ... {text[-5:]}"


def _type_name(value: object) -> str:
    """Return the type of a YAML value in plain words."""
    return YAML_KINDS.get(type(value).__name__, type(value).__name__)
