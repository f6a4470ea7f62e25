"""Files that a user may give to the wrong command: a study, a config, a map, a city, a trace."""

import shlex
from pathlib import Path

from cosim.config.data import read_toml
from sumo_nets.map_files import refuse_map

_SHIPPED = Path(__file__).parents[1] / "studies" / "shipped"
_OF_A_STUDY = {"study", "grid", "zip", "base"}


def is_study_file(path: Path) -> bool:
    """Whether a TOML file is a study: it has a section that configs do not have. Or the name of a shipped study."""
    shipped = _SHIPPED / f"{path.name}.toml"
    if path.parent == Path() and not path.exists() and shipped.is_file():
        return True
    try:
        return bool(_OF_A_STUDY & read_toml(path, "study file").keys())
    except ValueError:  # what is wrong with it is said where it is read
        return False


def refuse_other_than_config(path: Path | None) -> None:
    """Raise ValueError, which names the right command, if a file is known to be no config of a run."""
    if path is None:
        return
    refuse_traffic(path)
    given = shlex.quote(str(path))
    if is_study_file(path):
        raise ValueError(f"{path} is a study, not the config of one run. Make its runs with: cosim sweep {given}")


def refuse_other_than_study(path: Path) -> None:
    """Raise ValueError, which names the right command, if a file is known to be no study."""
    if (path / "study.toml").is_file():
        from results.study import again  # here, because pandas takes its time

        raise ValueError(f"{path} is the folder of a study, not its file. Continue it with: {again(path)}")
    refuse_traffic(path)
    if path.suffix == ".toml" and path.is_file() and not _OF_A_STUDY & read_toml(path, "study file").keys():
        given = shlex.quote(str(path))
        raise ValueError(
            f"{path} is the config of one run: it has no [grid]. Run it with: cosim run {given}. Begin a study with: "
            "cosim init --study"
        )


def refuse_traffic(path: Path) -> None:
    """Raise ValueError, which names the right key, if a path is known to be a map, a run, a city or a trace."""
    from cosim.traffic.scenario import find

    refuse_map(path, "")
    given = shlex.quote(str(path))
    if (path / "manifest.json").is_file():
        raise ValueError(
            f"{path} is the folder of a run, not a TOML file. Its config is {given}/config.toml. Its traffic is "
            f"replayed with --set traffic.scenario={given}."
        )
    if path.suffix == ".toml":
        return
    try:
        find(str(path))
    except ValueError:  # it is none
        return
    raise ValueError(f"{path} is traffic, not a TOML file. Give it with --set traffic.scenario={given}.")
