"""Pictures of occupancy maps: grey levels and modes as in ROS, and what is no map's picture.

The expected cells follow nav2_map_server (as in Humble) pixel by pixel, in exact
arithmetic.
"""

from __future__ import annotations

import os
import struct
import zlib
from fractions import Fraction

import numpy as np
import pytest
from PIL import Image

from srs_twin.errors import InputError
from srs_twin.scenario.map_file import read_map

SHAPE = (9, 13)


def write_map(picture, *, free="0.196", occupied="0.65", more=""):
    path = picture.with_suffix(".yaml")
    path.write_text(
        f"image: {picture.name}\nresolution: 0.05\norigin: [-0.5, -0.5, 0.0]\n"
        f"occupied_thresh: {occupied}\nfree_thresh: {free}\n{more}"
    )
    return path


def covered(path, shape) -> np.ndarray:
    """Return how many rectangles cover each cell, the upper row first."""
    count = np.zeros(shape, dtype=int)
    for polygon in read_map(path):
        corners = np.rint((np.array(polygon.corners) + 0.5) / 0.05).astype(int)
        (left, low), (right, high) = corners.min(axis=0), corners.max(axis=0)
        count[low:high, left:right] += 1
    return count[::-1]


def ros_cell(colours, white, mode, negate, free, occupied) -> int:
    """Return the value of a cell in nav2_map_server's grid; −1 is unknown."""
    shade = Fraction(sum(int(each) for each in colours), white * len(colours))
    occupancy = shade if negate else 1 - shade
    if occupied < occupancy:
        return 100
    if occupancy < free:
        return 0
    return (
        -1 if mode == "trinary" else round((occupancy - free) / (occupied - free) * 100)
    )


def chunk(kind, data):
    return (
        struct.pack(">I", len(data))
        + kind
        + data
        + struct.pack(">I", zlib.crc32(kind + data))
    )


def png(width, height, depth, kind, rows, more=b""):
    """Return a PNG file of rows of bytes."""
    header = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    pixels = zlib.compress(b"".join(b"\0" + row for row in rows))
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + more
        + chunk(b"IDAT", pixels)
        + chunk(b"IEND", b"")
    )


def draw(rng, channels, white):
    """Return pixels, some of them close to the thresholds."""
    values = rng.integers(0, white + 1, (*SHAPE, channels))
    near = np.rint(
        white * rng.choice([0, 0.196, 0.804, 0.65, 0.35, 0.9, 0.995, 1], SHAPE)
    ).astype(int)
    near = np.clip(near + rng.integers(-1, 2, SHAPE), 0, white)
    return np.where(rng.random(SHAPE)[..., None] < 0.6, near[..., None], values)


def pixels(values, white):
    """Return colours (rows, columns, 3) and white of drawn values."""
    return np.broadcast_to(values, (*SHAPE, 3)), white


def by_pillow(mode, suffix):
    def write(path, rng):
        if mode == "P":
            palette = rng.integers(0, 256, (16, 3))
            index = rng.integers(0, 16, SHAPE)
            picture = Image.fromarray(index.astype(np.uint8), "L")
            picture.putpalette(palette.astype(np.uint8).tobytes())
            picture.save(path)
            return palette[index], 255
        values = draw(rng, 3 if mode == "RGB" else 1, 255)
        if mode == "1":
            values = np.where(values > 100, 255, 0)
        picture = Image.fromarray(values.squeeze().astype(np.uint8))
        picture.convert(mode).save(path)
        return pixels(values, 255)

    write.suffix = suffix
    return write


def pgm(white, *, text=False, comment=""):
    def write(path, rng):
        values = draw(rng, 1, white)
        header = (
            f"P{2 if text else 5}\n{comment}13 {comment}9\n{comment}{white}\n".encode()
        )
        numbers = "".join(
            f"{each}{comment and f' # {each}'}\n" for each in values.ravel()
        ).encode()
        path.write_bytes(header + (numbers if text else values.astype("u1").tobytes()))
        return pixels(values, white)

    write.suffix = ".pgm"
    return write


def raw_png(depth):
    def write(path, rng):
        full = 2**depth - 1
        values = draw(rng, 1, full)
        bits = (values.reshape(SHAPE)[..., None] >> np.arange(depth)[::-1]) & 1
        rows = [np.packbits(each.ravel()).tobytes() for each in bits]
        path.write_bytes(png(13, 9, depth, 0, rows))
        return pixels(values * (255 // full), 255)

    write.suffix = ".png"
    return write


COMMENT = "# 0.050 m/pix\n"
WRITERS = {
    "pillow": (
        [by_pillow(m, ".png") for m in ("1", "L", "P", "RGB")]
        + [by_pillow("L", ".pgm")]
    ),
    # Each level is a whole number of 255ths.
    "P5": [pgm(white) for white in (1, 5, 51, 255)] + [pgm(255, comment=COMMENT)],
    "P2": (
        [pgm(white, text=True) for white in (1, 15, 255)]
        + [pgm(white, text=True, comment=COMMENT) for white in (85, 255)]
    ),
    "png": [raw_png(depth) for depth in (2, 4)],
}


@pytest.mark.parametrize("library", WRITERS)
def test_cells_agree_with_ros(tmp_path, library):
    """Formats × bit depths × modes × negate."""
    rng = np.random.default_rng(42)
    for k, write in enumerate(WRITERS[library]):
        for mode in ("trinary", "scale"):
            for negate in (False, True):
                picture = tmp_path / f"{k}{write.suffix}"
                colours, white = write(picture, rng)
                thresholds = [("0.196", "0.65"), ("0.1", "0.9"), ("0.0", "1.0")]
                free, occupied = thresholds[rng.integers(3)]
                path = write_map(
                    picture,
                    free=free,
                    occupied=occupied,
                    more=f"mode: {mode}\nnegate: {str(negate).lower()}\n",
                )
                rule = (white, mode, negate, Fraction(free), Fraction(occupied))
                expected = [
                    [
                        ros_cell(colours[row, column], *rule) != 0
                        for column in range(SHAPE[1])
                    ]
                    for row in range(SHAPE[0])
                ]
                assert (covered(path, SHAPE) == np.array(expected)).all(), (
                    library,
                    k,
                    mode,
                    negate,
                    free,
                )


WALL = np.full((20, 40), 254, dtype=np.uint8)
WALL[5:, 18:20] = 0


def test_words_for_negate_and_mode(tmp_path):
    picture = tmp_path / "wall.png"
    Image.fromarray(WALL).save(picture)
    for more in ("", "mode: Trinary\n", "negate: '0'\n", "negate: No\n"):
        assert (covered(write_map(picture, more=more), WALL.shape) == (WALL == 0)).all()
    for yes in ("1", '"1"', "Yes", "on", "y"):
        path = write_map(picture, more=f"negate: {yes}\n")
        assert (covered(path, WALL.shape) == (WALL > 0)).all()


ALLOWED = "at most 8 bits per channel and without transparency"


def test_deep_and_transparent_pictures_are_told_what_is_allowed(tmp_path):
    deep = Image.fromarray(WALL.astype(np.uint16))
    deep.save(tmp_path / "grey of 16 bits.png")
    deep.save(tmp_path / "grey of 16 bits.pgm")
    colours = png(5, 4, 16, 2, [bytes(30)] * 4)
    (tmp_path / "colours of 16 bits.png").write_bytes(colours)
    wall = Image.fromarray(WALL)
    wall.save(tmp_path / "transparent level.png", transparency=254)
    wall.convert("LA").save(tmp_path / "grey with alpha.png")
    wall.convert("RGBA").save(tmp_path / "colours with alpha.png")
    pictures = list(tmp_path.iterdir())
    assert len(pictures) == 6
    for picture in pictures:
        with pytest.raises(InputError, match=ALLOWED):
            read_map(write_map(picture))


def sparse(path, width, height):
    path.write_bytes(png(width, height, 8, 0, [b""]))


def two_headers(path):
    data = png(4, 1, 8, 0, [b"\0" * 4])
    second = struct.pack(">IIBBBBB", 20_000, 20_000, 8, 0, 0, 0, 0)
    path.write_bytes(data[:33] + chunk(b"IHDR", second) + data[33:])


HOSTILE = {
    "fifo": (os.mkfifo, "not a regular file"),
    "folder": (os.mkdir, "a folder"),
    "gigapixels": (
        lambda path: sparse(path, 2**31 - 1, 2**31 - 1),
        "must have between 1 and 25,000,000 pixels",
    ),
    "none": (lambda path: sparse(path, 0, 5), ALLOWED),
    "two headers": (two_headers, "must have between 1 and 25,000,000 pixels"),
    "empty": (lambda path: path.write_bytes(b""), ALLOWED),
    "cut": (
        lambda path: path.write_bytes(
            png(40, 20, 8, 0, [bytes(range(41, 1, -1))] * 20)[:-24]
        ),
        "damaged (",
    ),
    "cut pgm": (
        lambda path: path.write_bytes(b"P5 40 20 255\n" + bytes(700)),
        "damaged (",
    ),
    "maxval": (
        lambda path: path.write_bytes(b"P5 1 1 65536\n\0\0"),
        "damaged (maxval must be greater than 0",
    ),
    "pdf": (lambda path: path.write_bytes(b"%PDF-1.7\n"), ALLOWED),
    "jpeg": (lambda path: Image.new("L", (4, 4)).save(path, "JPEG"), ALLOWED),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_invalid_pictures_are_rejected(tmp_path, name):
    """By content, before Pillow reads it, with one message that names the place in the map."""
    make, words = HOSTILE[name]
    make(tmp_path / "a.png")
    with pytest.raises(InputError) as error:
        read_map(write_map(tmp_path / "a.png"))
    assert "a.yaml:1:8: image: " in str(error.value) and words in str(error.value)
    assert "\n" not in str(error.value)


def test_format_is_read_from_the_content_not_the_suffix(tmp_path):
    Image.fromarray(WALL).save(tmp_path / "a.png")
    (tmp_path / "a.png").rename(tmp_path / "a.pgm")
    assert covered(write_map(tmp_path / "a.pgm"), WALL.shape).sum() == 30


def test_speckled_map_is_refused_above_twenty_thousand_rectangles(tmp_path):
    """On a checkerboard every second cell is a rectangle."""

    def speckled(rows):
        board = np.indices((rows, 200)).sum(axis=0) % 2 == 0
        Image.fromarray(board).save(tmp_path / "wall.png")
        return write_map(tmp_path / "wall.png")

    assert len(read_map(speckled(200))) == 20_000
    with pytest.raises(
        InputError,
        match="wall.yaml:1:8: image: .* need 20,100 rectangles, but only 20,000 are"
        " allowed; remove specks",
    ):
        read_map(speckled(201))


def test_stripes_of_twenty_thousand_rows_are_few_rectangles(tmp_path):
    array = np.full((20_000, 8), 255, dtype=np.uint8)
    array[:, ::2] = 0
    Image.fromarray(array).save(tmp_path / "a.png")
    assert len(read_map(write_map(tmp_path / "a.png"))) == 4


def test_other_spellings_of_a_map(tmp_path):
    """Missing thresholds and a number with an exponent; a path of Windows is refused."""
    Image.fromarray(WALL).save(tmp_path / "a.png")
    path = write_map(tmp_path / "a.png")
    text = path.read_text()
    plain = read_map(path)
    for new in (
        text.replace("0.05\n", "5e-2\n"),
        text[: text.index("occupied")],
        text + "frame: map\n",
    ):
        path.write_text(new)
        assert read_map(path) == plain
    path.write_text(text.replace("a.png", "sub\\a.png"))
    with pytest.raises(InputError, match=r"a\.yaml:1:8: image: .*no such file"):
        read_map(path)
