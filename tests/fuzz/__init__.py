"""Fuzzing of every decoder, file reader and socket command: `python -m tests.fuzz [TARGET...]`.

A target is a function of bytes that must return: what it may refuse with, it catches itself. `mutate` makes inputs from
the kept corpus (`corpus/<target>/`: seeds, and every input that ever found a fault), `child` feeds them in a process of
its own, with a limit of memory, and `runner` watches it, with a limit of time for each input.
"""
