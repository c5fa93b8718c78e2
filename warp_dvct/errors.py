"""The package's errors. A message names the prim, file or value that is wrong and says what to do about it."""


class DvctError(Exception):
    """Base of every error that a user can cause and mend; the CLI prints it on stderr and exits with 1."""


class StageError(DvctError):
    """A stage, prim or texture that cannot be read as a scene."""


class OptionError(DvctError):
    """A setting, flag or argument outside of what is understood."""


class FileError(DvctError):
    """A file that cannot be read or written."""


class DeviceError(DvctError):
    """A device that is absent, or that ran out of memory."""


class CheckError(DvctError):
    """A kernel wrote a number that is not finite or out of its range; only ``--check`` looks."""
