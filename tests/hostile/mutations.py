"""Random changes of valid files, which know the format that they break."""

from __future__ import annotations

import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from copy import deepcopy
from random import Random
from typing import Any

Mutation = Callable[[Random, bytes], bytes]

#: Integers at which sizes overflow, and numbers that are none.
INTEGERS = (
    -1,
    0,
    1,
    2**15,
    2**16,
    2**31 - 1,
    2**31,
    2**32,
    2**53,
    2**63 - 1,
    2**63,
    2**64,
    10**400,
)
TEXTS = (
    *map(str, INTEGERS),
    *("1e308", "-1e308", "1e400", "1e-320", "nan", "NaN", "inf", "-Infinity", "0x10", "1_0", "٣"),
    *("", " ", "..", "../../x", "/etc/passwd", "a\0b", "\x1b[2J", "\u202e", "\ud800", "x" * 5000),
)
_VALUES: tuple[object, ...] = (
    *INTEGERS,
    *(1e308, -1e308, 5e-324, float("nan"), float("inf"), -0.0),
    *(None, True, False, [], {}, [[]], {"": None}, [None] * 100, {"a": {"b": [1]}}),
    *TEXTS,
)
#: Chunks are repeated up to this size, so that what a parser takes is its own fault.
_MAX_BYTES = 1 << 20
_DIGITS = re.compile(rb"-?\d+(\.\d+)?")
_FORMATS = ("<H", ">H", "<i", ">i", "<I", ">I", "<q", ">q", "<f", "<d")


# --- any bytes ----------------------------------------------------------------------------------


def mutate_bytes(random: Random, content: bytes) -> bytes:
    """Change a few bytes, chunks, numbers or the length."""
    for _ in range(random.choice((1, 1, 1, 2, 4))):
        content = random.choice(_OF_BYTES)(random, content)[:_MAX_BYTES]
    return content


def _span(random: Random, content: bytes) -> tuple[int, int]:
    start = random.randrange(len(content) + 1)
    return start, min(len(content), start + random.choice((1, 2, 4, 8, 64, 1000)))


def _flip(random: Random, content: bytes) -> bytes:
    if not content:
        return content
    changed = bytearray(content)
    for _ in range(random.choice((1, 1, 8))):
        changed[random.randrange(len(changed))] ^= 1 << random.randrange(8)
    return bytes(changed)


def _set(random: Random, content: bytes) -> bytes:
    start, end = _span(random, content)
    byte = random.choice((0, 0xFF, 0x7F, 0x80, 0x20, 0x0A, random.randrange(256)))
    return content[:start] + bytes([byte]) * (end - start) + content[end:]


def _truncate(random: Random, content: bytes) -> bytes:
    return content[: random.randrange(len(content) + 1)]


def _append(random: Random, content: bytes) -> bytes:
    added = random.choice((b"\0", b"\xff", b"\n", content)) or b"\0"
    most = max(1, _MAX_BYTES // len(added))
    return content + added * min(most, random.choice((1, 3, 1000)))


def _duplicate(random: Random, content: bytes) -> bytes:
    start, end = _span(random, content)
    return content[:end] + content[start:end] * random.choice((1, 10)) + content[end:]


def _delete(random: Random, content: bytes) -> bytes:
    start, end = _span(random, content)
    return content[:start] + content[end:]


def _swap(random: Random, content: bytes) -> bytes:
    a, b, c = sorted(random.randrange(len(content) + 1) for _ in range(3))
    return content[:a] + content[b:c] + content[a:b] + content[c:]


def _binary_number(random: Random, content: bytes) -> bytes:
    form = random.choice(_FORMATS)
    size = struct.calcsize(form)
    start = random.randrange(max(1, len(content) - size + 1))
    if form[1] in "fd":
        number = struct.pack(form, random.choice((float("nan"), float("inf"), -1.0, 1e38)))
    else:
        value = random.choice(INTEGERS) % (1 << 8 * size)
        number = value.to_bytes(size, "little" if form[0] == "<" else "big")
    return content[:start] + number + content[start + size :]


def _written_number(random: Random, content: bytes) -> bytes:
    found = list(_DIGITS.finditer(content[:100_000]))
    if not found:
        return content
    match = random.choice(found)
    text = random.choice(TEXTS).encode("utf-8", "surrogatepass")
    return content[: match.start()] + text + content[match.end() :]


_OF_BYTES: tuple[Mutation, ...] = (
    *(_flip, _set, _truncate, _append, _duplicate, _delete, _swap),
    *(_binary_number, _binary_number, _written_number, _written_number),
)


# --- JSON ---------------------------------------------------------------------------------------


def mutate_json(random: Random, content: bytes) -> bytes:
    """Change values, keys and types of a JSON document, now and then its text as well."""
    document = [json.loads(content)]
    for _ in range(random.choice((1, 1, 2, 5))):
        _mutate_value(random, document)
    text = json.dumps(document[0], ensure_ascii=random.random() < 0.7)
    changed = text.encode("utf-8", "surrogatepass")
    return mutate_bytes(random, changed) if random.random() < 0.2 else changed


def places(document: Any) -> list[tuple[Any, Any]]:
    """Every value in a document, as its container and its key there."""
    found, waiting = [], [document]
    while waiting:
        holder = waiting.pop()
        for key in holder if isinstance(holder, dict) else range(len(holder)):
            found.append((holder, key))
            if isinstance(holder[key], (dict, list)):
                waiting.append(holder[key])
    return found


def _mutate_value(random: Random, document: list[Any]) -> None:
    holder, key = random.choice(places(document))
    action = random.choice(("set", "set", "set", "drop", "rename", "nest", "wrap", "copy"))
    if action == "set":
        holder[key] = deepcopy(random.choice(_VALUES))
    elif action == "nest":
        for _ in range(random.choice((10, 60, 150))):
            holder[key] = [holder[key]]
    elif action == "wrap":
        holder[key] = {"a": holder[key]}
    elif action == "copy":
        other = random.choice(places(document))
        copied = json.dumps(other[0][other[1]])
        if len(copied) < 1_000_000:
            holder[key] = json.loads(copied)
    elif holder is not document and isinstance(holder, dict):
        value = holder.pop(key)
        if action == "rename":
            holder[random.choice(TEXTS)] = value
    elif holder is not document:
        del holder[key]


# --- tables -------------------------------------------------------------------------------------


def mutate_csv(random: Random, content: bytes) -> bytes:
    """Change fields, rows, columns and separators of a CSV table."""
    rows = [line.split(",") for line in content.decode().splitlines()]
    for _ in range(random.choice((1, 1, 3))):
        row = random.choice(rows)
        action = random.choice(("field", "field", "field", "drop", "copy", "shorten", "column"))
        if action == "field" and row:
            row[random.randrange(len(row))] = random.choice((*TEXTS, '"', 'a"b', "a\rb", "a;b"))
        elif action == "drop" and len(rows) > 1:
            rows.remove(row)
        elif action == "copy":
            rows.append(list(row))
        elif action == "shorten":
            del row[-1:]
        elif action == "column":
            value = random.choice(TEXTS)
            rows = [[*old, value] for old in rows]
    text = random.choice(("\n", "\n", "\n", "\r\n", "\r")).join(map(",".join, rows))
    changed = text.encode("utf-8", "surrogatepass")
    return mutate_bytes(random, changed) if random.random() < 0.3 else changed


# --- archives -----------------------------------------------------------------------------------


def mutate_npz(random: Random, content: bytes) -> bytes:
    """Change a member of an archive under right checksums, or the bytes of the archive."""
    if random.random() < 0.4:
        return mutate_bytes(random, content)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    name = random.choice(list(members))
    end = members[name].find(b"\n") + 1
    header, data = members[name][:end], members[name][end:]
    if data.startswith(b"{"):
        data = mutate_json(random, data)
        members[name] = re.sub(rb"\(\d+,\)", b"(%d,)" % len(data), header) + data
    elif random.random() < 0.5:
        members[name] = mutate_bytes(random, header) + data
    else:
        members[name] = header + mutate_bytes(random, data)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for written, body in members.items():
            archive.writestr(written, body)
    return stream.getvalue()


# --- images -------------------------------------------------------------------------------------


def mutate_image(random: Random, content: bytes) -> bytes:
    """Change the bytes; those of a PNG's chunks mostly under right checksums."""
    if not content.startswith(b"\x89PNG") or random.random() < 0.3:
        return mutate_bytes(random, content)
    chunks = list(_chunks(content))
    number = random.randrange(len(chunks))
    name, body = chunks[number]
    action = random.choice(("body", "body", "body", "drop", "twice", "name"))
    if action == "body":
        chunks[number] = (name, mutate_bytes(random, body))
    elif action == "drop":
        del chunks[number]
    elif action == "twice":
        chunks.insert(random.randrange(len(chunks)), chunks[number])
    elif action == "name":
        names = (b"IHDR", b"IDAT", b"zTXt", b"iTXt", b"iCCP", b"eXIf", b"PLTE", b"tRNS", b"acTL")
        chunks[number] = (random.choice(names), body)
    return content[:8] + b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in chunks
    )


def _chunks(content: bytes) -> list[tuple[bytes, bytes]]:
    found, position = [], 8
    while position < len(content):
        (size,) = struct.unpack_from(">I", content, position)
        name = content[position + 4 : position + 8]
        found.append((name, content[position + 8 : position + 8 + size]))
        position += 12 + size
    return found
