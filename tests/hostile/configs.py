"""Configs from the schema: every key with values that no experiment has."""

import random
import signal
import typing
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass

from cosim.config import CHOICES, Config, load
from cosim.run import check

NUMBERS = (
    "nan", "inf", "-inf", "-1", "0", "-0.0", "1e-300", "5e-324", "1e300", "-1e300", "1.5", "0.1", "2147483648",
    "9223372036854775807", "9223372036854775808", "1" + "0" * 400, "1e6", "10000000", "3", "-3.7",
)  # fmt: skip
OTHERS = (
    '""', '"\\u0000"', '"../../etc/passwd"', '"/dev/zero"', '"' + "x" * 5000 + '"', "[]", "{}", "true", "false", "[[]]",
    "1979-05-27", '"[/]2"', "'nowhere.py:Class'", "'os:system'", "[" * 3000 + "]" * 3000, "[nan]", "[inf, 1]", '"ä€😀"',
)  # fmt: skip


def keys() -> list[tuple[str, typing.Any]]:
    """Every key of the config, those of the choices at hand included, with its type."""
    found: list[tuple[str, typing.Any]] = []

    def walk(model: typing.Any, prefix: str) -> None:
        hints = typing.get_type_hints(model, include_extras=True)
        for field in fields(model):
            of = hints[field.name]
            items = typing.get_args(of)
            if is_dataclass(of):
                walk(of, f"{prefix}{field.name}.")
            elif typing.get_origin(of) is tuple and items and is_dataclass(items[0]):
                walk(items[0], f"{prefix}{field.name}.0.")
            else:
                found.append((prefix + field.name, of))

    walk(Config, "")
    for section, (_, at_hand, _) in CHOICES.items():
        for choice in at_hand.values():
            if (params := getattr(choice, "Params", None)) is not None:
                walk(params, f"{section}." if section != "attacks" else "attacks.0.")
    return sorted({name: of for name, of in found}.items(), key=lambda item: item[0])


def cases(seed: int, n: int) -> Iterator[list[str]]:
    """Overrides: each key in turn with a hostile value, some with a second key."""
    rng = random.Random(seed)
    known = keys()
    for i in range(n):
        name, of = known[i % len(known)] if i < 2 * len(known) else rng.choice(known)
        sets = [f"{name}={_value(rng, of)}"]
        if rng.random() < 0.3:
            other, its = rng.choice(known)
            sets.append(f"{other}={_value(rng, its)}")
        yield sets


def _value(rng: random.Random, of: typing.Any) -> str:
    text = str(of)
    if "tuple" in text and rng.random() < 0.7:
        n = rng.choice([0, 1, 2, 3, 4, 5, 4, 4, 2])
        inner = ", ".join(rng.choice(NUMBERS) for _ in range(n))
        return f"[{inner}]" if rng.random() < 0.7 else f"[[{inner}], [{inner}]]"
    if "Literal" in text and rng.random() < 0.5:
        options = [v for a in typing.get_args(of) for v in (typing.get_args(a) or [a]) if isinstance(v, str)]
        return f'"{rng.choice(options)}"' if options else '"?"'
    return rng.choice(NUMBERS if rng.random() < 0.75 else OTHERS)


class TooLong(BaseException):
    """No answer within the time allowed."""


@contextmanager
def limit(seconds: float) -> Iterator[None]:
    """Raise TooLong in what takes longer."""

    def stop(*_: object) -> None:
        raise TooLong(f"no answer within {seconds:g} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def attempt(sets: list[str], seconds: float = 10.0) -> str:
    """Reads and checks a config: `accepted`, or `refused` in one line; anything else is raised."""
    try:
        with limit(seconds):
            check(load(None, sets))
    except ValueError as error:
        text = " ".join(str(error).split())
        assert text, "an empty message"
        assert len(text) < 20_000, f"a message of {len(text)} characters"
        return "refused"
    return "accepted"
