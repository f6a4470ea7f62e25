"""The manifest of a run: its config, versions, inputs and outcome."""

import hashlib
import os
import platform
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import tomli_w

from cosim import __version__
from cosim.base import durable
from cosim.base.codes import BASE_VARIANT, Role, labels
from cosim.base.durable import sha256 as sha256
from cosim.config.config import Config
from cosim.door.load import Source
from cosim.runs.source import source
from results.inventory import Inventory
from results.manifest import write_manifest
from results.tables import SCHEMA_VERSION, kept

PACKAGES = ("libsumo", "numpy", "scipy", "numba", "pyarrow", "pandas")
_OF_ENGINES = {"embree": ("embreex",)}
CONFIG = "config.toml"
GRAZING = "not columnar: where rays graze edges, tables differ from those of the columnar caster"
_RESERVE = ".reserve"
_RESERVE_BYTES = 1 << 16


@cache
def versions(engine: str) -> dict[str, str]:
    """Versions of Python, of cosim, and of the packages on which results with this ray caster depend, if installed."""
    found = {"python": platform.python_version(), "cosim": __version__}
    for package in (*PACKAGES, *_OF_ENGINES.get(engine, ())):
        with suppress(PackageNotFoundError):  # recorded traffic is replayed without SUMO
            found[package] = version(package)
    return found


_UNSET = "\0"
_UNSET_LINE = re.compile(r'^(\s*)(.+) = "\\u0000"$', re.MULTILINE)


def toml_text(data: dict[str, Any]) -> str:
    """Plain data as TOML. A key that is not set becomes a comment."""
    return _UNSET_LINE.sub(r"\1# \2 is not set", tomli_w.dumps(_marked(data)))


def _marked(data: Any) -> Any:
    if isinstance(data, dict):
        return {k: _UNSET if v is None else _marked(v) for k, v in data.items()}
    return [_marked(v) for v in data] if isinstance(data, list | tuple) else data


@dataclass(slots=True)
class Manifest:
    """The content of `manifest.json`. The file is always replaced as a whole, so it is never incomplete."""

    folder: Path
    config: Config
    net: dict[str, str]
    """Name, licence and attribution of the network; checksums of all input files."""
    choices: dict[str, Source]
    """The class behind every choice of the config, with file and checksum if it is the user's own."""
    steps: int = 0
    """Completed steps."""
    timings_s: dict[str, float] = field(default_factory=dict)
    timings_ahead_s: dict[str, float] = field(default_factory=dict)
    """Seconds per stage that other threads computed beside the steps, in parallel with `timings_s`."""
    summary: dict[str, Any] = field(default_factory=dict)
    error: str = ""
    """Why the run failed."""
    resumed_at: list[int] = field(default_factory=list)
    """Steps at which the run was resumed."""
    config_sha256: str = ""
    """SHA-256 of `config.toml`."""

    def begin(self) -> None:
        """Write the manifest with status "running", then the config. From then on the run can be resumed."""
        self.config_sha256 = hashlib.sha256(self._config()).hexdigest()
        self.write("running")
        durable.write(self.folder / CONFIG, self._config())
        durable.sync_folder(self.folder)

    def keep_config(self, before: Mapping[str, Any]) -> None:
        """Check the config of a run to be resumed, and write `config.toml` if the run was killed before it did.

        Raises
        ------
        ValueError
            If the config differs from the recorded one.
        """
        path = self.folder / CONFIG
        self.config_sha256 = hashlib.sha256(self._config()).hexdigest()
        if self.config_sha256 != before.get("config_sha256"):
            raise ValueError(f"{path} was changed since. A resumed run goes on with the same config: run again.")
        if not path.exists():
            durable.write(path, self._config())

    def write(self, status: str, inventory: Inventory | None = None) -> None:
        """Write the manifest with a status: running, finished, interrupted or failed.

        A running run reserves some disk space, so that its last manifest fits on a full disk.
        """
        inventory = inventory or Inventory()
        content = {
            "schema_version": SCHEMA_VERSION,
            "status": status,
            "dt_s": self.config.traffic.step_s,
            "steps": inventory.end_step,
            "sense_every_steps": self.config.sense_every_steps,
            "seed": self.config.seed,
            "traffic_seed": self.config.traffic.seed,
            "variants": [BASE_VARIANT, *(variant.name for variant in self.config.trust_variant)],
            "roles": labels(Role),
            "config": self.config.to_dict(),
            "config_sha256": self.config_sha256,
            "versions": versions(self.config.lidar.engine),
            "source": source(),
            "net": self.net,
            "choices": {key: asdict(source) for key, source in self.choices.items()},
            "timings_s": _rounded(self.timings_s),
            "timings_ahead_s": _rounded(self.timings_ahead_s),
            "summary": self.summary,
            "inventory": inventory.summary(kept(self.config.record.level)),
            **({"lidar_engine": GRAZING} if self.config.lidar.engine != "columnar" else {}),
            **({"error": self.error} if self.error else {}),
            **({"resumed_at": self.resumed_at} if self.resumed_at else {}),
        }
        reserve = self.folder / _RESERVE
        reserve.unlink(missing_ok=True)
        write_manifest(self.folder, content)
        if status == "running":
            with suppress(OSError), open(reserve, "wb") as file:  # some file systems cannot reserve space
                os.posix_fallocate(file.fileno(), 0, _RESERVE_BYTES)

    def _config(self) -> bytes:
        return toml_text(self.config.to_dict()).encode()


def _rounded(seconds: dict[str, float]) -> dict[str, float]:
    return {stage: round(s, 3) for stage, s in seconds.items()}
