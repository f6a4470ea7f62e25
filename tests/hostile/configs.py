"""Configs from the schema: every key with values that no experiment has."""

import math
import random
import signal
import typing
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass

from cosim.config.config import Config, load
from cosim.door.kinds import SECTIONS
from cosim.runs.check import check
from trust.params import TrustParams

NUMBERS = (
    "nan", "inf", "-inf", "-1", "0", "-0.0", "1e-300", "5e-324", "1e300", "-1e300", "1.5", "0.1", "2147483648",
    "9223372036854775807", "9223372036854775808", "1" + "0" * 400, "1e6", "10000000", "3", "-3.7",
)  # fmt: skip
OTHERS = (
    '""', '"\\u0000"', '"../../etc/passwd"', '"/dev/zero"', '"' + "x" * 5000 + '"', "[]", "{}", "true", "false", "[[]]",
    "1979-05-27", '"[/]2"', "'nowhere.py:Class'", "'os:system'", "[" * 3000 + "]" * 3000, "[nan]", "[inf, 1]", '"ä€😀"',
)  # fmt: skip


def keys() -> list[tuple[str, typing.Any, tuple[str, ...]]]:
    """Every key of the config, those of the choices at hand included: name, type, what has to be chosen for it."""
    found: dict[str, tuple[typing.Any, tuple[str, ...]]] = {}

    def walk(model: typing.Any, prefix: str, chosen: tuple[str, ...] = ()) -> None:
        hints = typing.get_type_hints(model, include_extras=True)
        for field in fields(model):
            of = hints[field.name]
            items = typing.get_args(of)
            if is_dataclass(of):
                walk(of, f"{prefix}{field.name}.", chosen)
            elif typing.get_origin(of) is tuple and items and is_dataclass(items[0]):
                walk(items[0], f"{prefix}{field.name}.0.", chosen)
            else:
                found.setdefault(prefix + field.name, (of, chosen))

    walk(Config, "")
    for section, kind in SECTIONS.items():
        prefix = "attacks.0." if section == "attacks" else f"{section}."
        for name, choice in kind.shipped.items():
            if (params := getattr(choice, "Params", None)) is not None:
                walk(params, prefix, (f"{prefix}{kind.key}={name}",))
    walk(TrustParams, "trust_variant.0.", ("trust_variant.0.name=other",))
    return sorted((name, *rest) for name, rest in found.items())


def cases(seed: int, n: int) -> Iterator[list[str]]:
    """Overrides: each key in turn with a hostile value, some with a second key."""
    rng = random.Random(seed)
    known = keys()
    rng.shuffle(known)
    for i in range(n):
        sets: list[str] = []
        first = known[i % len(known)]
        for name, of, chosen in (first, rng.choice(known))[: 1 + (rng.random() < 0.3)]:
            sets += [choice for choice in chosen if choice not in sets]
            sets.append(f"{name}={_value(rng, of)}")
        yield sets


def _value(rng: random.Random, of: typing.Any) -> str:
    text = str(of)
    if "tuple" in text and rng.random() < 0.8:
        n = rng.choice([0, 1, 2, 3, 4, 5, 4, 4, 2])
        inner = ", ".join(rng.choice(NUMBERS) if rng.random() < 0.4 else _edge(rng, of) for _ in range(n))
        return f"[{inner}]" if rng.random() < 0.7 else f"[[{inner}], [{inner}]]"
    if "Literal" in text and rng.random() < 0.8:
        options = [v for a in typing.get_args(of) for v in (typing.get_args(a) or [a]) if isinstance(v, str)]
        return f'"{rng.choice(options)}"' if options else '"?"'
    if ("float" in text or "int" in text) and rng.random() < 0.7:
        return _edge(rng, of)
    return rng.choice(NUMBERS if rng.random() < 0.75 else OTHERS)


def _edge(rng: random.Random, of: typing.Any) -> str:
    """A bound of a number, just inside or outside of it, or anywhere within, small numbers as often as large ones."""
    bounds = sorted(b for b in _metadata(of) if isinstance(b, int | float))
    if not bounds:
        return rng.choice(NUMBERS)
    bound = float(rng.choice(bounds))
    if rng.random() < 0.5:
        low, high = (max(abs(float(b)), 1e-9) for b in (bounds[0], bounds[-1]))
        bound = math.copysign(math.exp(rng.uniform(*sorted((math.log(low), math.log(high))))), bound)
    if "float" not in str(of):
        return str(int(bound) + rng.choice([-1, 0, 1]))
    return repr(rng.choice([bound, math.nextafter(bound, math.inf), math.nextafter(bound, -math.inf)]))


def _metadata(of: typing.Any) -> Iterator[typing.Any]:
    """Bounds anywhere in an annotation."""
    for item in (*getattr(of, "__metadata__", ()), *typing.get_args(of)):
        for name in ("ge", "gt", "le", "lt"):
            if hasattr(item, name):
                yield getattr(item, name)
        yield from _metadata(item)


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
