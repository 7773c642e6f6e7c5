"""Choice of the codec for a sample: option > Encoding > key > the preset's hint > first bytes."""

from __future__ import annotations

import re
from collections.abc import Collection
from functools import lru_cache
from typing import Literal

from coview_stream.errors import ConfigError, EncodingError
from coview_stream.messages.types import Sample

MessageKind = Literal["cloud", "odometry", "pose"]

# codecs for a MIME type; the first one if no schema is named
_MIMES: dict[str, tuple[str, ...]] = {
    "": (),
    "application/octet-stream": ("xyz", "xyzi"),
    "zenoh/bytes": ("xyz", "xyzi"),
    "zenoh/string": (),
    "application/cdr": ("cdr",),
    "application/protobuf": ("foxglove", "keelson"),
    "application/x-protobuf": ("foxglove", "keelson"),
    "application/json": ("json",),
    "text/json": ("json",),
}
_MUTE = ("", "application/octet-stream", "zenoh/bytes", "zenoh/string")  # meaningless without a schema
_WITHOUT_SCHEMA = ("application/json", "text/json")  # parameters are a charset or similar
_LIVOX = ("livox_ros_driver2", "livox_ros_driver", "livox_interfaces")
_SCHEMAS: dict[str, tuple[str, tuple[MessageKind, ...]]] = {  # codec of each schema, and the kinds that it carries
    "xyz": ("xyz", ("cloud",)),
    "xyzi": ("xyzi", ("cloud",)),
    "sensor_msgs.pointcloud2": ("cdr", ("cloud",)),
    **{f"{package}.custommsg": ("cdr", ("cloud",)) for package in _LIVOX},
    "nav_msgs.odometry": ("cdr", ("odometry",)),
    "geometry_msgs.posewithcovariancestamped": ("cdr", ("pose",)),
    "foxglove.pointcloud": ("foxglove", ("cloud",)),
    "foxglove.poseinframe": ("foxglove", ("odometry", "pose")),
    "foxglove.frametransform": ("foxglove", ("odometry", "pose")),
    "core.envelope": ("keelson", ("cloud", "odometry", "pose")),
}
_KEELSON: dict[str, tuple[MessageKind, ...]] = {"point_cloud": ("cloud",), "frame_transform": ("odometry", "pose")}
# CDR: two bytes of encoding, two of options (padding at the end); the codec names XCDR2 when it refuses it
_MAGIC = re.compile(rb"(?P<cdr>\0[\0\1\6-\x0b]\0[\0-\3])|(?P<json>\{)")
_RMW_KEY = re.compile(r"/([^/]+::msg::dds_::[^/]+_)/[^/]+$")
_KEELSON_KEY = re.compile(r"/@v0/.*pubsub/([^/]+)/")
_MAX_ENCODING = 256  # characters


def codec_for(kind: MessageKind, names: Collection[str], sample: Sample, option: str | None, hint: str | None) -> str:
    """Choose among the codecs ``names``; ConfigError for an unknown option or hint, EncodingError if none fits."""
    for setting, name in (("option", option), ("hint", hint)):
        if name is not None and name not in names:
            raise ConfigError(f"encoding {setting} {name!r} for {kind}; it must be one of {', '.join(names)}")
    if option is not None:
        return option
    allowed, by_key = _claims(kind, sample.encoding[: _MAX_ENCODING + 1], sample.key)
    if allowed:
        name = next((name for name in (by_key, hint) if name in allowed), allowed[0])
    else:
        name = by_key or hint or ""
        if not name and (magic := _MAGIC.match(sample.payload)):
            name = str(magic.lastgroup)
        if not name:
            raise EncodingError(
                f"{sample.key}: no encoding is set, and the payload is neither CDR nor JSON; set one, or name it by "
                "option"
            )
    if name not in names:
        raise EncodingError(f"{sample.key}: {name} (encoding {sample.encoding[:80]!r}) cannot carry {kind}")
    return name


@lru_cache(maxsize=256)
def _claims(kind: MessageKind, encoding: str, key: str) -> tuple[tuple[str, ...], str]:
    """Return the codecs that the encoding allows, best first (empty: any), and the key's codec or ''."""
    mime, _, parameters = encoding.partition(";")
    mime = mime.strip().lower()
    if len(encoding) > _MAX_ENCODING or mime not in _MIMES:
        raise EncodingError(f"{key}: unknown encoding {encoding[:80]!r}; see the table of encodings")
    schema = _schema(parameters)
    if schema and mime not in _WITHOUT_SCHEMA:
        codec = _of_schema(kind, schema, f"{key}: encoding {encoding[:80]!r}")
        if codec not in _MIMES[mime]:
            raise EncodingError(f"{key}: encoding {encoding[:80]!r} contradicts itself")
        return (codec,), ""
    by_key = ""
    if rmw := _RMW_KEY.search(key):
        by_key = _of_schema(kind, _schema(rmw[1]), f"{key}: key")
    elif keelson := _KEELSON_KEY.search(key):
        if kind not in _KEELSON.get(keelson[1], (kind,)):
            raise EncodingError(f"{key}: subject {keelson[1]!r} cannot carry {kind}")
        by_key = "keelson"
    return (() if mime in _MUTE else _MIMES[mime]), by_key


def _schema(parameters: str) -> str:
    """Normalize ``a/msg/B``, ``a::msg::dds_::B_``, ``schema=a.B`` and the like to ``a.b``."""
    text = parameters.split(";")[0].split("=")[-1].strip(" \t\"'").lower()
    parts = [part.rstrip("_") for part in re.split(r"[/:.]+", text)]
    return ".".join(part for part in parts if part not in ("msg", "dds", ""))


def _of_schema(kind: MessageKind, schema: str, source: str) -> str:
    codec, kinds = _SCHEMAS.get(schema, ("", ()))
    if not codec:
        raise EncodingError(f"{source}: no codec knows {schema!r}")
    if kind not in kinds:
        raise EncodingError(f"{source}: {schema!r} cannot carry {kind}")
    return codec
