"""Calibrated car-following: the vehicle types of a SUMO scenario with other parameters, in copies of its files."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from sumo_nets.sumocfg import Sumocfg
from sumo_nets.vtypes import read
from sumo_nets.xml import chunks, contains

_COMMON = {"carFollowModel": "EIDM", "decel": "1.5", "jerkmax": "5"}
_CAR = {**_COMMON, "accel": "1.5", "tau": "1.0", "minGap": "2.0"}
_HEAVY = {**_COMMON, "tau": "1.5"}
CALIBRATED: Mapping[str, Mapping[str, str]] = {
    **dict.fromkeys(("passenger", "taxi", "hov", "evehicle", "private", "delivery", "emergency"), _CAR),
    **dict.fromkeys(("truck", "trailer", "bus", "coach"), _HEAVY),
    "bicycle": _COMMON,
}
"""Attributes of a vehicle type by SUMO's vehicle class. Other attributes, sizes and speeds stay as the scenario says.

The model is the extended Intelligent Driver Model [1]_, which follows drone trajectories at a signalised junction
better than Krauss' model [2]_. Deceleration, time gap and standstill gap of cars, and the time gap of heavy vehicles
are those with which the authors of the Intelligent Driver Model simulate city traffic [3]_.
Deviations: cars accelerate with 1.5 m/s2, within the realistic range of 0.8 to 2.5 m/s2 of [4]_; [3]_ has 1.0. Heavy
vehicles (2.0 m/s2 in [3]_) and bicycles (no source) decelerate as cars do. The largest jerk is the upper end of the
range of [5]_, where SUMO has 3 m/s3. This jerk and `YELLOW_MPS2` are fitted: with them, cars brake suddenly about as
often as measured drivers.

References
----------
.. [1] Salles, Kaufmann, Reuss, "Extending the Intelligent Driver Model in SUMO and Verifying the Drive Off Trajectories
   with Aerial Measurements", SUMO User Conference 2020.
.. [2] Salles, Oswald, Reuss, arXiv:2408.03722, 2024 (abstract).
.. [3] Treiber, Kesting, simulator movsim: sim/bookScenarioStartStop/startStop_IDM.xprj (cars, v0 = 15 m/s) and
   sim/buildingBlocks/trafficlight.xprj (trucks).
.. [4] Treiber, traffic-simulation.de, info/info_IDM.html, table of parameters.
.. [5] Oswald, pycarmodel_calibration, carmodel_calibration/fileaccess/parameter.py, bounds.
"""
YELLOW_MPS2 = 1.5
"""Drivers stop at a yellow light if this deceleration suffices. SUMO's default of 3 m/s2 makes them brake harder than
they usually do."""
_DEFAULT_TYPES = {"DEFAULT_VEHTYPE": "passenger", "DEFAULT_BIKETYPE": "bicycle"}
"""Types of vehicles without a type, and their classes."""
_TAG = re.compile(rb"""<!--.*?-->|<vType(?=[\s/>])(?:[^>"']|"[^"]*"|'[^']*')*>""", re.DOTALL)
_KEY = "traffic.car_following = calibrated"


def calibrated(config: Sumocfg, folder: Path) -> Sumocfg:
    """The configuration with calibrated vehicle types. Files that define types are replaced by copies in `folder`.

    Raises
    ------
    ValueError
        If a file cannot be copied: it includes others, is included, or says otherwise how vehicles follow each other.
    """
    for path in config.included:
        if contains(path, b"<vType"):
            raise ValueError(f"{_KEY}: {path} is included by another file and defines vehicle types. {_CURE}")
    files = dict(config.files)
    defined: set[str] = set()
    for option in ("additional-files", "route-files"):
        copies: list[Path] = []
        for path in config.files[option]:
            if contains(path, b"<vType"):
                defined |= read([path]).keys()
                copy = folder / f"types-{option}-{len(copies)}.xml"
                copy.write_bytes(_rewritten(path))
                path = copy
            copies.append(path)
        files[option] = tuple(copies)
    defaults = folder / "types-by-default.add.xml"
    types = [
        f'    <vType id="{name}" vClass="{vclass}"{_attributes(vclass)}/>\n'
        for name, vclass in _DEFAULT_TYPES.items()
        if name not in defined
    ]
    defaults.write_text("<additional>\n" + "".join(types) + "</additional>\n", encoding="utf-8")
    files["additional-files"] = (defaults, *files["additional-files"])
    return replace(config, files=files)


_CURE = "Put the types into an additional file of the .sumocfg that includes nothing, or remove the key."


def _rewritten(path: Path) -> bytes:
    """The content of a file, with calibrated types."""
    text = b"".join(chunks(path))
    if b"<include" in text or b"<carFollowing" in text:
        what = "includes other files" if b"<include" in text else "has elements <carFollowing-...>"
        raise ValueError(f"{_KEY}: {path} defines vehicle types and {what}. {_CURE}")
    return _TAG.sub(lambda found: _calibrated_tag(found.group()), text)


def _calibrated_tag(tag: bytes) -> bytes:
    """The tag of a vehicle type with the attributes of its class. Comments and other classes stay as they are."""
    vclass = re.search(rb"""\svClass\s*=\s*["'](\w+)""", tag)
    name = vclass.group(1).decode() if vclass else "passenger"
    if tag.startswith(b"<!--") or name not in CALIBRATED:
        return tag
    for key in (*CALIBRATED[name], "sigma"):
        tag = re.sub(rb"""\s""" + key.encode() + rb"""\s*=\s*("[^"]*"|'[^']*')""", b"", tag)
    return b"<vType" + _attributes(name).encode() + tag.removeprefix(b"<vType")


def _attributes(vclass: str) -> str:
    given = CALIBRATED[vclass]
    return "".join(f' {key}="{value}"' for key, value in given.items())
