"""Reception round the corner: two measured facts beside the model, without any parameter set for them.

Mangel, Michl, Klemp, Hartenstein, "Real-world measurements of non-line-of-sight reception quality for 5.9 GHz IEEE
802.11p at intersections" (Nets4Cars 2011): 50 m from the centre of eight city junctions, reception is mostly well above
50 %. Clayton, Stocker, Alwane, Hassan, "Observations of 5.9-GHz radio propagation and 802.11p network performance at
road junctions" (Radio Science 54, 2019): more than 90 % up to 45 to 70 m around three junctions.

The bounds 0.5 and 0.9 are those of the measurements. The others (0.75, 0.95) were set beside the figures of this model.
"""

import numpy as np
from scipy.special import gammaincc

from cosim.base import rng
from cosim.radio.link_cache import LinkCache
from cosim.radio.message_round import Stations
from cosim.radio.params import RadioParams
from sensors.line_of_sight import LosOfPlaces, WallIndex
from tests.bench.radio import city_blocks

LOS = LosOfPlaces(WallIndex.of(city_blocks(1500.0)))


def reception(leg_m: float) -> float:
    """Share of frames received without interference, both ends `leg_m` from a junction's centre on crossing streets.

    The mean over 81 junctions and four corners each. A frame is received if its faded power exceeds the threshold.
    """
    params = RadioParams()
    centre = 125.0 * np.stack(np.meshgrid(np.arange(1, 10), np.arange(1, 10)), -1).reshape(-1, 2)
    out = []
    for sx, sy in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        ends = [centre + [sx * leg_m, 0], centre + [0, sy * leg_m]]
        xyz_m = np.column_stack([np.concatenate(ends), np.full(2 * len(centre), 1.6)])
        stations = Stations(rng.keys(np.uint64(1), np.arange(len(xyz_m))), xyz_m, len(xyz_m))
        links = LinkCache.of(stations, params, 1, LOS).links
        for i in range(len(centre)):
            of = slice(links.ptr[i], links.ptr[i + 1])
            hit = np.flatnonzero(links.receiver[of] == i + len(centre))
            power_mw = float(links.power_mw[of][hit[0]]) if len(hit) else 0.0
            threshold_mw = 10 ** (params.receiver.detectable_dbm / 10)
            m = 1.5 if np.hypot(leg_m, leg_m) <= 80 else 0.75
            out.append(gammaincc(m, m * threshold_mw / power_mw) if power_mw else 0.0)
    return float(np.mean(out))


def test_reception_fifty_metres_from_the_centre_is_well_above_one_half():
    assert 0.75 <= reception(50.0) <= 0.95


def test_nine_tenths_are_received_up_to_some_fifty_metres():
    assert reception(45.0) >= 0.9 > reception(70.0)


def test_reception_falls_with_distance():
    share = [reception(leg) for leg in (30.0, 50.0, 70.0, 100.0)]
    assert share == sorted(share, reverse=True)
