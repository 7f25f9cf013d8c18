"""Read ROS 1 and ROS 2 bags and MCAP files through the optional package rosbags.

A source is `TOPIC.FIELD`, such as `/imu.orientation.x`, with `[0]` for an element of an array and
`[elbow]` for that element whose name the message's `name` field gives (`sensor_msgs/JointState`).
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from garat_jax.diagnosis.tables import damaged
from garat_jax.errors import UserError, unknown_name

SUFFIXES = (".bag", ".mcap", ".db3")
"""Of single files; a ROS 2 bag is a folder."""
REORDERED = 0.1
"""Seconds by which a message's stamp may be before another's that was recorded earlier."""
_SOURCE = re.compile(r"(?P<topic>[^.\[\]]+)\.(?P<field>[^\[\]]+)(\[(?P<element>[^\[\]]+)\])?")


class Series(NamedTuple):
    """One number over time.

    Attributes:
        time: Seconds since the bag's beginning, [T].
        values: [T].
    """

    time: np.ndarray
    values: np.ndarray


class Source(NamedTuple):
    """Where a number is found in the messages of a topic."""

    topic: str
    field: str
    element: str | None


def is_bag(path: Path) -> bool:
    """Say whether a path is a bag: a file of its kind, or a folder with metadata.yaml."""
    return path.suffix.lower() in SUFFIXES or (path / "metadata.yaml").is_file()


def parse_source(text: str) -> Source:
    """Split `TOPIC.FIELD[ELEMENT]`.

    Raises:
        UserError: The text is no such thing.
    """
    match = _SOURCE.fullmatch(text)
    if match is None:
        raise UserError(
            f"{text!r} in the map names no field of a topic; expected /TOPIC.FIELD, "
            "/TOPIC.FIELD[0] or /TOPIC.FIELD[JOINT]"
        )
    return Source(match["topic"], match["field"], match["element"])


def read_bag(path: Path, sources: Sequence[str], clock: str) -> dict[str, Series]:
    """Read some numbers from a bag.

    Args:
        path: A .bag, .mcap or .db3 file, or the folder of a ROS 2 bag.
        sources: `TOPIC.FIELD`, with `[ELEMENT]` where the field is an array.
        clock: `header` takes the messages' own stamps where they have any, `log` the times at which
            they were recorded.

    Raises:
        UserError: rosbags is not installed, the bag cannot be read, or it lacks a source or the
            definition of its message type.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise UserError(
            f"{path}: bags need the package rosbags; install it with: pip install 'garat_jax[logs]'"
        ) from error
    try:
        wanted = {text: parse_source(text) for text in sources}
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            found = _rows(reader, wanted, clock)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    except Exception as error:  # what rosbags raises on damaged bags is not documented
        raise damaged(path, "a bag", error) from error
    return {text: _series(path, text, rows) for text, rows in found.items()}


def _rows(
    reader: Any, wanted: Mapping[str, Source], clock: str
) -> dict[str, list[tuple[float, float]]]:
    """Return seconds and value of each message of an open bag, by the names of `wanted`.

    Messages that do not hold an element by its name are passed over: an arm and its gripper may
    tell their joints' states on one topic. A number counts elements where no message has that name.
    """
    topics = reader.topics
    for source in wanted.values():
        if source.topic not in topics:
            raise unknown_name("topic", source.topic, topics)
    chosen = {source.topic for source in wanted.values()}
    connections = [c for c in reader.connections if c.topic in chosen]
    found: dict[str, list[tuple[float, float]]] = {text: [] for text in wanted}
    counted: dict[str, list[tuple[float, float]]] = {text: [] for text in wanted}
    others: dict[str, set[str]] = {}
    for connection, stamp, raw in reader.messages(connections):
        message = _message(reader, raw, connection)
        stamp = (_header_stamp(message) if clock == "header" else 0) or stamp
        time = 1e-9 * (stamp - reader.start_time)
        for text, source in wanted.items():
            if source.topic == connection.topic:
                try:
                    found[text].append((time, _value(message, source)))
                except _NotInMessageError as error:
                    others.setdefault(text, set()).update(error.names)
                    if error.counted is not None:
                        counted[text].append((time, _number(error.counted, source)))
    for text, source in wanted.items():
        found[text] = found[text] or counted[text]
        if text in others and not found[text]:
            raise _no_such_element(source, others[text])
    return found


def _no_such_element(source: Source, names: set[str]) -> UserError:
    """Return the error of an element that no message has, by the names that theirs have."""
    if str(source.element).isdigit():
        what = f"no message of {source.topic} has an element [{source.element}]"
        return UserError(f"{what} of {source.field}, by name or by number")
    if not names:
        return UserError(f"{source.topic} names no elements, so it has no [{source.element}]")
    return unknown_name(f"name in {source.topic}", str(source.element), sorted(names))


class _NotInMessageError(Exception):
    """A message does not name the element that is wanted.

    Attributes:
        names: Those that it has.
        counted: What stands at the place that the element is, if that is a number; None else, and
            where there is no such place.
    """

    def __init__(self, names: set[str], counted: Any):
        super().__init__(names)
        self.names, self.counted = names, counted


def _message(reader: Any, raw: bytes, connection: Any) -> Any:
    """Return what a message holds; its type, and those within, have to be defined."""
    try:
        return reader.deserialize(raw, connection.msgtype)
    except KeyError as error:
        raise UserError(
            f"nothing defines the message type {error} of {connection.topic}, neither the bag nor "
            "ROS 2 Humble; record as MCAP, which holds definitions, or take another topic"
        ) from error


def _series(path: Path, text: str, rows: list[tuple[float, float]]) -> Series:
    if not rows:
        raise UserError(f"{path}: there is no message with {text}")
    time, values = np.asarray(rows).T
    back = np.maximum.accumulate(time) - time
    if back.max() > REORDERED:
        late = int(np.argmax(back > REORDERED))
        raise UserError(
            f"{path}: the stamps of {text} go back by {back[late]:.3g} s at message {late + 1}, as "
            'if a clock began anew; set clock = "log" in the map, or record each run by itself'
        )
    order = np.argsort(time, kind="stable")
    return Series(time[order], values[order])


def _fields(message: Any) -> Mapping[str, Any]:
    """Return a message's fields by name; rosbags makes each message a dataclass."""
    return vars(message) if type(message).__module__ != "builtins" else {}


def _header_stamp(message: Any) -> int:
    """Return the nanoseconds of a message's header; 0 if it has none or it was left empty."""
    header = _fields(message).get("header")
    if header is None:
        return 0
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def _value(message: Any, source: Source) -> float:
    value, owner = message, message
    for name in source.field.split("."):
        owner, fields = value, _fields(value)
        if name not in fields:
            known = [field for field in fields if not field.startswith("_")]
            raise unknown_name(f"field of {source.topic}", name, known)
        value = fields[name]
    if source.element is not None:
        value = _element(value, owner, source)
    return _number(value, source)


def _number(value: Any, source: Source) -> float:
    if not np.ndim(value) == 0 or not isinstance(value, int | float | np.number | np.bool_):
        raise UserError(
            f"{source.topic}.{source.field} is no number; name one of its elements, such as "
            f"{source.topic}.{source.field}[0]"
        )
    return float(value)


def _element(values: Any, owner: Any, source: Source) -> Any:
    """Return the element with a number, or with the name that the message gives it."""
    element = str(source.element)
    if np.ndim(values) != 1:
        raise UserError(f"{source.topic}.{source.field} is no array, so it has no [{element}]")
    names = list(_fields(owner).get("name", ()))
    if element not in names:
        place = int(element) if element.isdigit() else len(values)
        raise _NotInMessageError(set(names), values[place] if place < len(values) else None)
    index = names.index(element)
    if index >= len(values):
        raise UserError(
            f"{source.topic}.{source.field} has {len(values)} elements, so it has no [{element}]"
        )
    return values[index]
