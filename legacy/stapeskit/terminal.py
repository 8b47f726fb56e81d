"""Text for a terminal."""

# Controls but tab and line feed, and what turns the order of writing (Unicode, bidirectional formatting).
_ORDERS = dict.fromkeys(
    (*range(9), *range(11, 32), *range(127, 160), *range(0x202A, 0x202F), *range(0x2066, 0x206A)), "?"
)


def plain(text: str) -> str:
    """Return a text with ``?`` for every character that a terminal would obey instead of showing.

    Names and contents of files are in messages; they may come from anyone.
    """
    return text.translate(_ORDERS)
