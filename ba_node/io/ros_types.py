# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Know the ROS 2 message types without a ROS installation: make, encode and decode messages.

Types of Jazzy come with rosbags, those of ``ba_msgs`` from the definitions in this package. A bag brings its own
definitions, and is decoded by them: fields that a later version adds do no harm, fields that are missing are named.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterator, Mapping
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

# Fields of the inputs that nothing here reads, so that a recording may have them otherwise, and those it may lack.
_UNREAD = frozenset({"covariance", "r", "p"})
_OPTIONAL = frozenset({"binning_x", "binning_y", "roi"})
_LISTS = (Nodetype.ARRAY, Nodetype.SEQUENCE)
_TEXTS = ("string", "wstring")
# Second byte of messages in CDR, big and little endian; empty ones are the decoder's to refuse.
_PLAIN_CDR = (b"", b"\0", b"\1")

# Languages of definitions; recorders write the second where they do not find a package's .msg files.
MSG, IDL = LANGUAGES = ("ros2msg", "ros2idl")
# What a definition in a recording may be: code is made of it, for each field and each entry of an array of messages.
MAX_DEFINITION_BYTES = 2**18
MAX_DEFINITION_LINES = 4000
MAX_FIELDS = 2000
MAX_NESTING = 20


class TypeMismatchError(ValueError):
    """A message definition that cannot be used for what it claims to be."""


class RosbagsFactory:
    """Make messages as dataclasses of rosbags (a :class:`~ba_node.messages.factory.MessageFactory`)."""

    def make(self, type_name: str, **fields: Any) -> Any:
        """Return a message with all its fields."""
        return typestore().types[type_name](**fields)

    def array(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the array itself."""
        return np.ascontiguousarray(values)

    fixed = array


ROSBAGS_FACTORY = RosbagsFactory()


@functools.cache
def typestore() -> Typestore:
    """Return the message types of Jazzy and ``ba_msgs``."""
    store = get_typestore(Stores.ROS2_JAZZY)
    definitions = resources.files(__package__) / "ba_msgs"
    for file in sorted(definitions.iterdir(), key=lambda entry: entry.name):
        if file.name.endswith(".msg"):
            name = f"ba_msgs/msg/{file.name.removesuffix('.msg')}"
            store.register(get_types_from_msg(file.read_text(encoding="utf-8"), name))
    return store


def is_known(type_name: str) -> bool:
    """Return True if there is a definition of a type here."""
    return type_name in typestore().types


def schema_text(type_name: str) -> str:
    """Return the definition of a type and of all types in it, in the form ``ros2msg``."""
    text, _ = typestore().generate_msgdef(type_name, ros_version=2)
    return text


def type_hash(type_name: str) -> str:
    """Return the hash of a type as REP-2016 defines it (``RIHS01_...``)."""
    return typestore().hash_rihs01(type_name)


def encode(type_name: str, message: Any) -> bytes:
    """Return a message as little-endian CDR; one that is serialised already as it is."""
    if isinstance(message, bytes):
        return message
    return bytes(typestore().serialize_cdr(message, type_name, little_endian=True))


def decode(type_name: str, data: bytes) -> Any:
    """Return the message in CDR bytes, by our own definition of the type."""
    return typestore().deserialize_cdr(data, type_name)


def full_name(type_name: str) -> str:
    """Return ``package/msg/Type`` of ``package/Type``, as some recorders write it."""
    package, _, rest = type_name.partition("/")
    return type_name if "/" in rest or not rest else f"{package}/msg/{rest}"


def decoder(type_name: str, text: str, language: str = MSG) -> Callable[[bytes], Any]:
    """Return a function that decodes messages of a definition that came with a recording, in one of LANGUAGES.

    Raises:
        TypeMismatchError: the definition cannot be read.
    """
    return functools.partial(_decode, _store_of(type_name, text, language), type_name)


def check_definition(type_name: str, text: str, language: str = MSG) -> None:
    """Raise TypeMismatchError if a recording's definition of an input lacks a field or has it of another type."""
    wrong = list(_differences(type_name, _store_of(type_name, text, language)))
    if wrong:
        raise TypeMismatchError(f"{'; '.join(wrong)}: record it with the current message definitions")


@functools.lru_cache(maxsize=64)
def _store_of(type_name: str, text: str, language: str) -> Typestore:
    store = Typestore()
    size, lines = len(text), text.count("\n")
    if size > MAX_DEFINITION_BYTES or lines > MAX_DEFINITION_LINES:
        raise TypeMismatchError(
            f"the definition of {type_name!r} has {size} bytes in {lines} lines; read are up to {MAX_DEFINITION_BYTES}"
            f" in {MAX_DEFINITION_LINES}: record the message without fields that are not its own"
        )
    try:
        definitions = _types_in(type_name, text.replace("\r\n", "\n"), language)
        count = _expanded(definitions, type_name)
        if count <= MAX_FIELDS:
            store.register(definitions)
            store.get_msgdef(type_name)
    except Exception as error:  # the parser and the code generator raise whatever a strange text leads them to
        raise TypeMismatchError(f"the definition of {type_name!r} cannot be read: {error!r}") from error
    if count > MAX_FIELDS:
        raise TypeMismatchError(
            f"the definition of {type_name!r} makes {count} fields a message, or nests deeper than {MAX_NESTING}; read"
            f" are up to {MAX_FIELDS}: record the message without fields that are not its own"
        )
    return store


def _types_in(type_name: str, text: str, language: str) -> dict[str, Any]:
    if language == MSG:
        return get_types_from_msg(text, type_name)
    found: dict[str, Any] = {}
    without_includes = re.sub(r"^[ \t]*#.*$", "", text, flags=re.MULTILINE)
    for part in re.split(r"^=+\nIDL: .*\n", without_includes, flags=re.MULTILINE):
        found |= get_types_from_idl(part) if part.strip() else {}
    return found


def _expanded(definitions: Mapping[str, Any], type_name: str, depth: int = 0) -> int:
    """Return how many fields a message has with all that is in it, each entry of an array of messages counted."""
    if depth > MAX_NESTING:
        return MAX_FIELDS + 1
    total = 0
    for _, (kind, value) in definitions[type_name][1] if type_name in definitions else ():
        (inner, name), count = (value[0], int(value[1] or 1)) if kind in _LISTS else ((kind, value), 1)
        if inner == Nodetype.NAME:
            total += count * _expanded(definitions, str(name), depth + 1) + count
        else:
            total += count if name[0] in _TEXTS else 1
        if total > MAX_FIELDS:
            break
    return total


def _decode(store: Typestore, type_name: str, data: bytes) -> Any:
    if data[:1] == b"\0" and data[1:2] not in _PLAIN_CDR:
        raise ValueError(
            f"serialised as {data[:2].hex()}, another form of CDR: expected 0000 or 0001, as ROS 2 writes it"
        )
    return store.deserialize_cdr(data, type_name)


def _differences(type_name: str, theirs: Typestore) -> Iterator[str]:
    """Yield what a definition has otherwise than ours, nested types included."""
    if type_name not in theirs.fielddefs:
        yield f"{type_name} is not defined"
        return
    found = dict(theirs.fielddefs[type_name][1])
    for name, expected in typestore().fielddefs[type_name][1]:
        if name in _UNREAD or (name in _OPTIONAL and name not in found):
            continue
        if name not in found:
            yield f"{type_name} has no field {name} (expected {_show(expected)})"
        elif found[name] != expected:
            yield f"{type_name}: field {name} is {_show(found[name])}, expected {_show(expected)}"
        else:
            inner = expected[1][0] if expected[0] in _LISTS else expected
            if inner[0] == Nodetype.NAME:
                yield from _differences(str(inner[1]), theirs)


def _show(description: Any) -> str:
    kind, value = description
    if kind == Nodetype.BASE:
        return str(value[0])
    if kind == Nodetype.NAME:
        return str(value)
    inner, count = value
    return f"{_show(inner)}[{count or ''}]"
