"""The one error of this program."""


class Refused(Exception):  # noqa: N818  (it is no error of the program)
    """Something is not as it must be.

    Args:
        what: the thing at fault.
        given: what it is.
        expected: what it should be.
        fix: the next step for the person at the board.
    """

    def __init__(self, what: str, given: object, expected: str, fix: str) -> None:
        super().__init__(f"{what}: got {given}; expected {expected}. {fix}")
