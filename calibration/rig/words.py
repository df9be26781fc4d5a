"""Words of texts for people."""


def counted(count: int, noun: str, nouns: str = "") -> str:
    """Return a number with its noun, in the plural unless the number is 1.

    Args:
        count: the number.
        noun: the noun in the singular.
        nouns: the plural, where it is not the singular with an s.
    """
    return f"{count} {noun if count == 1 else nouns or f'{noun}s'}"
