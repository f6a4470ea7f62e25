"""Measures what the included trust models cost, all of them as variants of one run, beside the rest of the run."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

from cosim.base.threads import n_threads, use_threads
from cosim.config.config import Config, load
from cosim.messages.trust_hosts import HostState
from cosim.runs import recording
from cosim.runs.drive import warm_up
from cosim.runs.run import load_parts
from cosim.step.cycle import step
from cosim.step.state import State
from cosim.traffic.scenario import find
from results.recorder import Recorder
from tests.bench.suite import Row
from trust.models import MODELS

RUNS: dict[str, tuple[str, ...]] = {
    "default run": ("traffic.duration_s=100",),
    "study attacks": (
        "traffic.duration_s=80", "fleet.penetration_p=0.5", "trust.freshness_s=30",
        'attacks=[{attack = "ghost_insertion", share_p = 0.2, start_s = 20}]',
    ),
}  # fmt: skip
"""The first 100 s of the default run, and the base of the study `attacks`."""
_CALLS = ("open_step", "add_evaluations", "scores", "score_objects")


class Timed:
    """A trust model whose processor time is added up."""

    def __init__(self, model: Any, spent: Callable[[float], None]) -> None:
        self.model, self.spent = model, spent

    def __getattr__(self, name: str) -> Any:
        found = getattr(self.model, name)
        if name not in _CALLS:
            return found

        def timed(*given: Any, **named: Any) -> Any:
            begin = process_time()
            result = found(*given, **named)
            self.spent(process_time() - begin)
            return result

        return timed


def bench(names: Sequence[str] = tuple(MODELS)) -> Iterator[Row]:
    """Measure each run with one trust model and with all of them, on one thread.

    The cost of the models is the processor time of their methods (`TrustModel`, `score_objects`). The rest of the run
    is that of a run with `trupercept` alone, without the methods: traffic, sensing, messages, evaluation, fusion and
    tables; not the city, the warm-up of the traffic, and the compilation. What variants add beside the methods are
    look-ups, fusion with each variant's trust, and rows of tables.
    """
    threads = n_threads()
    use_threads(1)
    for name, keys in RUNS.items():
        config = load(None, [*keys, "compute.threads=1", "trust_variant=[]", 'trust.model="trupercept"'])
        some = tuple(f'{{name = "{one}", model = "{one}"}}' for one in names if one != "trupercept")
        every = load(None, [*keys, "compute.threads=1", f"trust_variant=[{', '.join(some)}]"])
        for one in (config, every):
            _measured(replace(one, traffic=replace(one.traffic, duration_s=12.0)))  # compiles, or loads kernels
        (alone_s, own_s), (total_s, all_s) = _measured(config), _measured(every)
        rest_s, models_s = alone_s - sum(own_s.values()), sum(all_s.values())
        yield f"{name}: rest of the run", rest_s, "s of processor time"
        yield f"{name}: {len(all_s)} trust models", models_s, "s of processor time"
        yield f"{name}: trust models, share of the rest", models_s / rest_s, ""
        added_s = total_s - models_s - rest_s
        yield f"{name}: look-ups, fusion and rows of the variants, share of the rest", added_s / rest_s, ""
        for model, seconds in sorted(all_s.items(), key=lambda of: -of[1])[:5]:
            yield f"{name}: {model}, share of the rest", seconds / rest_s, ""
    use_threads(threads)


def _measured(config: Config) -> tuple[float, dict[str, float]]:
    """Processor time of a run from its first step on, and that of each trust model in it [s]."""
    scenario, spent_s = find(config.traffic.scenario, config.traffic.trace), defaultdict[str, float](float)
    parts, registry, traffic = load_parts(config, scenario)

    def adds(name: str) -> Callable[[float], None]:
        def add(seconds: float) -> None:
            spent_s[name] += seconds

        return add

    state = State.start(parts)
    names = [config.trust.model, *(variant.name for variant in parts.trust.models[1:])]
    hosts = [HostState(Timed(host.model, adds(name))) for name, host in zip(names, state.trust.hosts, strict=True)]  # type: ignore[arg-type]
    state = replace(state, trust=replace(state.trust, hosts=hosts))
    try:
        warm_up(scenario.warmup_of(config.traffic), traffic, parts.watch, lambda *_: None)
        with TemporaryDirectory() as folder:
            variants = [variant.name for variant in parts.trust.variants]
            recorder = Recorder(Path(folder), config.record.level, config.record.block_steps, variants=variants)
            begin_s = process_time()
            for number in range(config.n_steps):
                state, result = step(traffic.advance(), state, parts)
                recording.step(recorder, result, config.traffic.step_s)
                recorder.reach(number)
                if recorder.is_block_end(number):
                    recorder.flush(recording.open_rows(state, parts, registry, number + 1))
            return process_time() - begin_s, dict(spent_s)
    finally:
        traffic.close()
