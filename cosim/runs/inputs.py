"""Files that a run reads besides its config, with checksums: the files of the scenario and the meshes."""

from pathlib import Path

from cosim.base.durable import sha256
from cosim.config.config import Config
from cosim.traffic.scenario import Scenario


def provenance(config: Config, scenario: Scenario) -> dict[str, str]:
    """Name, licence and attribution of the scenario, and the SHA-256 of every file that the run reads."""
    meshes = {f"sha256 {key}": found for key, found in mesh_checksums(config).items()}
    return scenario.provenance() | meshes


def changed_inputs(config: Config, scenario: Scenario, before: dict[str, str]) -> list[str]:
    """Names of the files whose content differs from the provenance of an earlier run of this config."""
    changed = scenario.changed_inputs(before)
    for key, found in mesh_checksums(config).items():
        if before.get(f"sha256 {key}", found) != found:
            changed.append(key)
    return changed


def mesh_checksums(config: Config) -> dict[str, str]:
    """SHA-256 of the mesh files by key of the config; an empty string if a file does not exist."""
    checksums = {}
    for section in ("meshes", "vehicle_meshes"):
        for number, mesh in enumerate(getattr(config, section)):
            path = Path(mesh.file)
            checksums[f"{section}.{number}.file"] = sha256(path) if path.is_file() else ""
    return checksums
