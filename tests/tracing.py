"""Coverage's tracer, which is called for every line that Python runs, is kept out of libraries that run many
and call nothing of ours: drawing, grammar of YAML, schemas, chunks of logs, making a command line, exporting
a graph, unparsing.

Their lines are not counted anyway.
"""

import ast
import functools
import sys


def untraced(function):
    """The same function, run without a tracer."""

    @functools.wraps(function)
    def run(*arguments, **named):
        tracer = sys.gettrace()
        if tracer is None:
            return function(*arguments, **named)
        sys.settrace(None)
        try:
            return function(*arguments, **named)
        finally:
            sys.settrace(tracer)

    return run


def keep_tracer_out() -> None:
    """From now on, where there is a tracer."""
    if sys.gettrace() is None:
        return
    import jsonschema
    import mcap.reader
    import torch
    import typer.main
    from matplotlib.figure import Figure
    from yaml.parser import Parser

    for owner, names in (
        (Figure, ["savefig"]),
        (jsonschema.Draft202012Validator, ["validate"]),
        (mcap.reader, ["breakup_chunk"]),
        (Parser, ["check_event", "peek_event", "get_event"]),
        (typer.main, ["get_command"]),
        (torch.onnx, ["export"]),
        (ast, ["unparse"]),
    ):
        for name in names:
            setattr(owner, name, untraced(getattr(owner, name)))
