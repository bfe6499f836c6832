"""What speaks against a lattice being the configured board: its count, its turn, its colours."""

from __future__ import annotations

from core.checkerboard.board import Board
from core.errors import NotRecognisedError

TURNED_BY_HALF = 2
"""Quarter turns of a board that is seen upside down."""

_HOW_TO_SEE = (
    "look in dcam-ctl preview at the writing beside the board. Upside down: turn the board by 180 "
    "degrees. Mirrored: switch ReverseX and ReverseY of the sub-camera off, or print the board "
    "again, not mirrored"
)


def no_place(columns: int, rows: int, board: Board) -> NotRecognisedError:
    """Say why columns x rows corners, as they lie in the image, have no place on the board."""
    seen = f"sub target: {columns}x{rows} inner corners are seen, that is {_squares(columns, rows)}"
    said = f"the config says {_squares(board.columns, board.rows)}"
    if (columns, rows) == (board.columns, board.rows):
        return NotRecognisedError(f"sub target: {_other_colours(board)}")
    if (columns, rows) == (board.rows, board.columns):
        return NotRecognisedError(f"{seen}, {said}; {_quarter_cure(columns, rows)}")
    if (columns, rows) == (board.columns + 1, board.rows + 1):
        cure = (
            "the config counts inner corners; count squares: set target.sub.squares_x = "
            f"{columns + 1}, squares_y = {rows + 1}"
        )
    elif 1 in {columns - board.columns, rows - board.rows}:
        cure = (
            "correct target.sub.squares_x and squares_y; if they count inner corners, add 1 to each"
        )
    else:
        cure = (
            "set target.sub.squares_x and squares_y to the board's squares, or mount the board "
            "of the config"
        )
    return NotRecognisedError(f"{seen} or more, {said}; {cure}")


def turned(quarter_turns: int, board: Board) -> NotRecognisedError:
    """Say what it means that a board on the pier fits only turned by quarter turns."""
    if quarter_turns == TURNED_BY_HALF:
        return NotRecognisedError(f"sub target: {_other_colours(board)}")
    text = (
        f"sub target: the board is seen turned by 90 degrees: {_squares(board.rows, board.columns)}"
        f" in the image, the config says {_squares(board.columns, board.rows)}"
    )
    if board.columns == board.rows:
        text = "sub target: the board is seen turned by 90 degrees, or mirrored"
        return NotRecognisedError(f"{text}; {_HOW_TO_SEE}. On its side: turn it by 90 degrees")
    return NotRecognisedError(f"{text}; {_quarter_cure(board.rows, board.columns)}")


def turns_if_mirrored(board: Board) -> int | None:
    """By how many quarter turns an upright board seems turned when it is mirrored.

    None where it shows in another way, or not at all.
    """
    odd = [(count + 1) % 2 == 1 for count in (board.columns, board.rows)]
    if odd[0] != odd[1]:
        return TURNED_BY_HALF
    return 1 if board.columns == board.rows and not odd[0] else None


def too_few_between_borders(
    columns: int | None, rows: int | None, board: Board
) -> NotRecognisedError:
    """Say that both borders of the board are seen, with fewer corners between than it should have.

    columns and rows are what is seen, None where a border is not.
    """
    axes = (("across", "x", columns, board.columns), ("down", "y", rows, board.rows))
    few = [(way, key, seen + 1, whole + 1) for way, key, seen, whole in axes if seen is not None]
    text = " and ".join(f"{seen} squares {way} of {whole}" for way, _, seen, whole in few)
    cure = " and ".join(f"target.sub.squares_{key} = {seen}" for _, key, seen, _ in few)
    return NotRecognisedError(
        f"sub target: the board in the image has {text} in the config; clear what covers its "
        f"border, or, if it is the whole board, set {cure}"
    )


def _squares(columns: int, rows: int) -> str:
    return f"{columns + 1}x{rows + 1} squares"


def _quarter_cure(columns: int, rows: int) -> str:
    return (
        "turn the board by 90 degrees, or, if squares_x and squares_y are swapped in the config, "
        f"set target.sub.squares_x = {columns + 1}, squares_y = {rows + 1}"
    )


def _other_colours(board: Board) -> str:
    """The count is right and the square at the origin is not: what can it be.

    Turned by half, the square top left keeps its colour if the sides are both even or both odd;
    mirrored, if that side is odd.
    """
    white = "the square top left in the image is white, at the board's WS origin it is black"
    odd = [(count + 1) % 2 == 1 for count in (board.columns, board.rows)]
    if odd[0] != odd[1]:
        return f"the board is seen upside down or mirrored ({white}); {_HOW_TO_SEE}"
    if not odd[0]:
        return (
            f"the board is seen mirrored ({white}); switch ReverseX and ReverseY of the "
            "sub-camera off, or print the board again, not mirrored"
        )
    return (
        f"the board is seen with black and white exchanged ({white}); print it again with black "
        "corner squares, or mount the board of the config"
    )
