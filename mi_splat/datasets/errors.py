"""What reading or writing a set of pictures may raise."""

from mi_splat.errors import MiSplatError


class DatasetError(MiSplatError):
    """A set of pictures cannot be read or written; the message names the file and says what to do."""


class DatasetWarning(UserWarning):
    """A set of pictures is read, but without something that it lists."""
