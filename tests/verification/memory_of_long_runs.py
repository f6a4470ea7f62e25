"""Memory of a run that lasts longer than its trace.

    python -m tests.verification.memory_of_long_runs SCENARIO.sumocfg TRACE.parquet SECONDS OUT

The trace (FCD) is replayed forwards and backwards in turn, so that as many vehicles stay on the road, and as near to
each other, as in the trace itself; all on four wheels and all motorcycles are equipped, everything is recorded at level
`standard`. Prints the most memory that the process held in each tenth of its time, its summary included.
"""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import psutil

_TIME = "timestep_time"
_PARTS, _EVERY_S = 10, 0.5
_CONFIG = """trust_variant = []
[traffic]
scenario = {scenario!r}
trace = {trace!r}
duration_s = {seconds}
[fleet]
penetration_p = 1.0
equipped_kinds = ["car", "van", "truck", "bus", "motorcycle"]
"""


def back_and_forth(trace: Path, seconds: float, to: Path) -> None:
    """The trace until its end, backwards to its beginning, and so on, for at least so long."""
    rows = pd.read_parquet(trace)
    times = np.sort(rows[_TIME].unique())
    step_s = times[1] - times[0]
    parts, end_s = [rows], times[-1]
    while end_s - times[0] < seconds:
        order = times[-2::-1] if len(parts) % 2 else times[1:]
        later = dict(zip(order, end_s + step_s * np.arange(1, len(order) + 1), strict=True))
        parts.append(rows[rows[_TIME].isin(order)].assign(**{_TIME: lambda part, later=later: part[_TIME].map(later)}))
        end_s = max(later.values())
    pd.concat(parts).sort_values(_TIME, kind="stable").to_parquet(to, index=False)


def watched(command: list[str]) -> list[tuple[float, float]]:
    """Run a command; its time [s] and memory [bytes] every half a second."""
    begin, held = time.monotonic(), []
    with subprocess.Popen(command) as process:
        about = psutil.Process(process.pid)
        while process.poll() is None:
            held.append((time.monotonic() - begin, float(about.memory_info().rss)))
            time.sleep(_EVERY_S)
    if process.returncode:
        sys.exit(process.returncode)
    return held


def main() -> None:
    scenario, trace, seconds, out = Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3]), Path(sys.argv[4])
    out.mkdir(parents=True, exist_ok=True)
    longer, config = out / "trace.parquet", out / "config.toml"
    back_and_forth(trace, seconds, longer)
    config.write_text(_CONFIG.format(scenario=str(scenario.resolve()), trace=str(longer.resolve()), seconds=seconds))
    held = watched([sys.executable, "-m", "cosim", "run", str(config), "--out", str(out / "run")])
    for part in np.array_split(np.array(held), _PARTS):
        print(f"{part[0, 0]:6.0f} to {part[-1, 0]:6.0f} s: {part[:, 1].max() / 1e9:.3f} GB")


if __name__ == "__main__":
    main()
