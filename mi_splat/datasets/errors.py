"""What reading and writing sets of images may raise or warn of."""

from mi_splat.errors import MiSplatError


class DatasetError(MiSplatError):
    """A set of images cannot be read or written; the message names the file and says
    what to do.
    """


class DatasetWarning(UserWarning):
    """A set of images is read, but not all that it lists, or in another way than its
    lists say.
    """
