"""``lanenet`` and ``python -m lanenet``: the command line; what stops a car does not wait for its imports."""

from __future__ import annotations

import os
import sys

from lanenet.search_path import without_working_folder


def main() -> None:
    """Run the command line; the entry point of the package."""
    # Before NumPy is imported: in systems of a few hundred unknowns, threads of BLAS wait for each other for
    # longer than they calculate, many times longer beside other work.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.path[:] = without_working_folder(sys.path)
    verb, words = (sys.argv[1:2] or [""])[0], sys.argv[2:]
    if verb == "stop":
        # As doctor has it: whoever stops a car does not look up how.
        words = [word for word in words if word != "--config"]
        sys.argv[2:] = words
    if verb == "stop" and words and not any(word.startswith("-") for word in words):
        from lanenet.onboard import stop

        raise SystemExit(stop.main(words))
    if verb == "drive":
        from lanenet.errors import MotorMayRunError
        from lanenet.onboard import stop

        try:
            stop.prepare_drive(words)
        except MotorMayRunError as error:
            raise SystemExit(stop.fail(error)) from None
    from lanenet.cli.app import main as command_line

    command_line()


if __name__ == "__main__":
    main()
