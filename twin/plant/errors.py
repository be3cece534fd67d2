"""The one exception a user's input may raise: it names what is wrong, where, and the remedy."""


class InputError(ValueError):
    """Input that cannot be used as it stands.

    The message is written for the person who made the input: it names the file, the key or channel, the
    unit and the remedy. Commands print it and end with exit code 2; nothing prints a traceback for it.
    """


class RunError(RuntimeError):
    """A run that could not go on for a reason outside the program, such as a rig that vanished.

    Commands print the message and end with exit code 3; what was recorded until then stays readable.
    """
