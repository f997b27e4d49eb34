"""The one exception that the command line turns into a single clear line and exit code 2."""


class HingesplatError(Exception):
    """Bad input or a state that the user can mend.

    The message is one line that says what is wrong, where (file, frame, field) and what to do.
    """
