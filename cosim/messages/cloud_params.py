"""Parameters of the point clouds that vehicles broadcast for early fusion."""

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Le

from cosim.base.bounds import Positive1000


@dataclass(frozen=True, kw_only=True, slots=True)
class EarlyFusionParams:
    """Whether vehicles broadcast their point clouds, and who merges them with their own before detection."""

    share: Literal["none", "objects", "sweep"] = "none"
    """What a vehicle broadcasts of each sweep, behind its detection message. `none`: nothing, and there is no early
    fusion. `objects`: the returns from road users, as if all others could be left out. `sweep`: all returns."""
    medium: Literal["radio", "unlimited"] = "radio"
    """`radio`: clouds are sent as frames over the medium of `[radio]`, among the detection messages. `unlimited`: every
    vehicle within `range_m` receives them, and the channel carries nothing; for studies of perception alone."""
    range_m: Positive1000 = 70.0
    """Largest distance of a partner whose cloud is merged [m]. The default is `COM_RANGE` of OpenCOOD."""
    partners: Annotated[int, Ge(0), Le(1000)] = 4
    """Largest number of partners, the nearest ones. OpenCOOD has `max_cav: 5`, the ego among them."""
    max_age_s: Annotated[float, Ge(0), Le(3600)] = 0.1
    """Largest age of a cloud that is merged [s]: one turn of a LiDAR at 10 Hz. Where an object moves, older returns lie
    behind it; they cannot be extrapolated. Where it is shorter than a step, as in the default world with
    `sensing_phase = "random"`, only partners that sense at the same step are merged."""
    bytes_per_return: Positive1000 = 16.0
    """Length of one return [B]: x, y, z and intensity in single precision, as data sets store it. An HDL-64E itself
    sends 384 of them in a packet of 1,206 bytes (manual of the S3, appendix E), 3.1 each."""
