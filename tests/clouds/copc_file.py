"""Writer of small COPC files for tests: laspy reads them, and writes none."""

import io
import struct

import numpy as np

WKT = (
    'PROJCS["WGS 84 / UTM zone 32N",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",9],PARAMETER["scale_factor",0.9996],'
    'PARAMETER["false_easting",500000],PARAMETER["false_northing",0],UNIT["metre",1],AUTHORITY["EPSG","32632"]]'
)
_SCALE = 0.001
_FORMAT, _RECORD = 6, 30


def write_copc(path, points, levels=3):
    """Write points (N, 3), metres, as an octree of ``levels`` levels; return the number of its nodes.

    Every point stands at one level, drawn by its number. The nodes of the last level are told of in pages of their own.
    """
    import lazrs

    points = np.asarray(points, dtype=np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    offset = np.floor(low)
    half = float((high - low).max()) / 2 + 0.01
    center = low + half
    keys = []
    for number, point in enumerate(points):
        level = min(levels - 1, number % 4)
        cell = np.floor((point - (center - half)) / (2 * half) * 2**level).astype(int)
        keys.append((level, *cell.tolist()))
    members = {(0, 0, 0, 0): []}
    for number, key in enumerate(keys):
        members.setdefault(key, []).append(number)
        for up in range(1, key[0] + 1):  # nodes on the way are there, if only with no points
            members.setdefault((key[0] - up, *(value >> up for value in key[1:])), [])
    vlr = lazrs.LazVlr.new_for_compression(_FORMAT, 0, True)
    laszip = bytes(vlr.record_data())
    wkt = WKT.encode() + b"\0"
    start = 375 + 54 + 160 + 54 + len(laszip) + 54 + len(wkt)
    body = io.BytesIO()
    body.write(b"\0" * start)
    compressor = lazrs.LasZipCompressor(body, vlr)
    filled = [key for key in sorted(members) if members[key]]
    for key in filled:
        chosen = members[key]
        if key != filled[0]:
            compressor.finish_current_chunk()
        compressor.compress_many(_records(points[chosen], offset))
    compressor.done()
    body.seek(start)
    sizes = dict(zip(filled, lazrs.read_chunk_table(body, vlr), strict=True))
    at, entries = start + 8, {}
    for key in filled:
        count, size = sizes[key]
        assert count == len(members[key])
        entries[key] = (at, size, count)
        at += size
    entries |= {key: (0, 0, 0) for key in members if not members[key]}
    raw = bytearray(body.getvalue())
    # the hierarchy: a page for the last level's nodes, one for the others
    raw += _vlr_head(b"copc", 1000, 0, extended=True)
    head_at = len(raw) - 60
    last = {key: entry for key, entry in entries.items() if key[0] == levels - 1 and levels > 1}
    page = b"".join(struct.pack("<4iQ2i", *key, *entry) for key, entry in sorted(last.items()))
    page_at = len(raw)
    raw += page
    root = {key: entry for key, entry in entries.items() if key not in last}
    root |= {key: (page_at, len(page), -1) for key in last}
    root_at = len(raw)
    raw += b"".join(struct.pack("<4iQ2i", *key, *entry) for key, entry in sorted(root.items()))
    struct.pack_into("<Q", raw, head_at + 20, len(raw) - head_at - 60)
    info = struct.pack("<5d2Q2d", *center, half, half / 8, root_at, len(raw) - root_at, 0.0, 0.0).ljust(160, b"\0")
    raw[:start] = (
        _header(points, start, offset, head_at)
        + _vlr_head(b"copc", 1, 160) + info
        + _vlr_head(b"laszip encoded", 22204, len(laszip)) + laszip
        + _vlr_head(b"LASF_Projection", 2112, len(wkt)) + wkt
    )  # fmt: skip
    path.write_bytes(raw)
    return len(filled)


def _records(points, offset):
    records = np.zeros((len(points), _RECORD), np.uint8)
    records[:, :12] = np.round((points - offset) / _SCALE).astype("<i4").view(np.uint8).reshape(-1, 12)
    records[:, 14] = 0x11  # the first return of one
    records[:, 16] = 2  # ground
    return np.ascontiguousarray(records).reshape(-1)


def _vlr_head(user, record, size, extended=False):
    return struct.pack("<H16sHQ32s" if extended else "<H16sHH32s", 0, user, record, size, b"")


def _header(points, start, offset, extended_at):
    low, high = points.min(axis=0), points.max(axis=0)
    sides = [value for pair in zip(high, low, strict=True) for value in pair]
    head = struct.pack(
        "<4sHHIHH8sBB32s32sHHHIIBHI5I3d3d6dQQIQ15Q",
        b"LASF", 0, 0x10, 0, 0, 0, b"", 1, 4, b"", b"", 1, 2026, 375, start, 3, _FORMAT | 0x80, _RECORD, 0,
        0, 0, 0, 0, 0, _SCALE, _SCALE, _SCALE, *offset, *sides, 0, extended_at, 1, len(points), len(points), *[0] * 14,
    )  # fmt: skip
    assert len(head) == 375
    return head
