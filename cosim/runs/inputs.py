"""Files that a run reads besides its config, with checksums: the files of the scenario and the meshes."""

from pathlib import Path

from cosim.base.durable import sha256
from cosim.config.config import Config
from cosim.traffic.scenario import Scenario


def provenance(config: Config, scenario: Scenario) -> dict[str, str]:
    """Name, licence and attribution of the scenario, and the SHA-256 of every file that the run reads."""
    return scenario.provenance() | {f"sha256 {key}": found for key, found in mesh_checksums(config).items()}


def changed_inputs(config: Config, scenario: Scenario, before: dict[str, str]) -> list[str]:
    """Names of the files whose content differs from the provenance of an earlier run of this config."""
    meshes = [key for key, found in mesh_checksums(config).items() if before.get(f"sha256 {key}", found) != found]
    return scenario.changed_inputs(before) + meshes


def mesh_checksums(config: Config) -> dict[str, str]:
    """SHA-256 of the mesh files by key of the config; an empty string if a file does not exist."""
    files = [(f"meshes.{n}.file", mesh.file) for n, mesh in enumerate(config.meshes)]
    files += [(f"vehicle_meshes.{n}.file", body.file) for n, body in enumerate(config.vehicle_meshes)]
    return {key: sha256(Path(file)) if Path(file).is_file() else "" for key, file in files}
