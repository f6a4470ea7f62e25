"""Cooperative awareness messages (CAM) of ETSI ITS, release 1: their fields and encoding.

Notes
-----
`CAM-PDU-Descriptions` is the module of EN 302 637-2 v1.4.1. The messages are valid in release 2 (TS 103 900), too.
"""

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from cosim.messages.etsi import (
    PROTOCOL,
    RELEASE_1,
    PositionVectors,
    header,
    its,
    maybe,
    place,
    reference_position,
    up,
    with_confidence,
)
from cosim.messages.uper import Enumerated, Integer, Member, Record, UperChoice, rows

CAM_MODULE = "CAM-PDU-Descriptions"
CAM_ID = 2
"""Identifier of the message."""


def _indicated(name: str, value: Integer, confidence: str, n: int) -> Record:
    """A value of release 1 whose confidence is one of n intervals."""
    return with_confidence(name, value, Enumerated(confidence, RELEASE_1, tuple(range(n))), RELEASE_1)


_HEADING = with_confidence(
    "Heading", its("HeadingValue", low=0, high=3601), its("HeadingConfidence", low=1, high=127), RELEASE_1
)
_SPEED = with_confidence(
    "Speed", its("SpeedValue", low=0, high=16383), its("SpeedConfidence", low=1, high=127), RELEASE_1
)
_VEHICLE_LENGTH = _indicated(
    "VehicleLength", its("VehicleLengthValue", low=1, high=1023), "VehicleLengthConfidenceIndication", 5
)
_ACCELERATION = with_confidence(
    "LongitudinalAcceleration",
    its("LongitudinalAccelerationValue", low=-160, high=161),
    its("AccelerationConfidence", low=0, high=102),
    RELEASE_1,
)
_CURVATURE = _indicated("Curvature", its("CurvatureValue", low=-1023, high=1023), "CurvatureConfidence", 8)
_YAW_RATE = _indicated("YawRate", its("YawRateValue", low=-32766, high=32767), "YawRateConfidence", 9)
_HIGH_FREQUENCY = (
    Member("heading", _HEADING),
    Member("speed", _SPEED),
    Member("driveDirection", Enumerated("DriveDirection", RELEASE_1, (0, 1, 2))),
    Member("vehicleLength", _VEHICLE_LENGTH),
    Member("vehicleWidth", its("VehicleWidth", low=1, high=62)),
    Member("longitudinalAcceleration", _ACCELERATION),
    Member("curvature", _CURVATURE),
    Member("curvatureCalculationMode", Enumerated("CurvatureCalculationMode", RELEASE_1, (0, 1, 2), True)),
    Member("yawRate", _YAW_RATE),
    maybe("accelerationControl"),
    maybe("lanePosition"),
    maybe("steeringWheelAngle"),
    maybe("lateralAcceleration"),
    maybe("verticalAcceleration"),
    maybe("performanceClass"),
    maybe("cenDsrcTollingZone"),
)
_HIGH_FREQUENCY_CONTAINER = {
    "basicVehicleContainerHighFrequency": Record("BasicVehicleContainerHighFrequency", CAM_MODULE, _HIGH_FREQUENCY),
    "rsuContainerHighFrequency": None,
}
_BASIC = (
    Member("stationType", its("StationType", low=0, high=255)),
    Member("referencePosition", reference_position(RELEASE_1)),
)
_CAM_PARAMETERS = (
    Member("basicContainer", Record("BasicContainer", CAM_MODULE, _BASIC, True)),
    Member("highFrequencyContainer", UperChoice("HighFrequencyContainer", CAM_MODULE, _HIGH_FREQUENCY_CONTAINER, True)),
    maybe("lowFrequencyContainer"),
    maybe("specialVehicleContainer"),
)
_AWARENESS = (
    Member("generationDeltaTime", Integer("GenerationDeltaTime", CAM_MODULE, 0, 65535)),
    Member("camParameters", Record("CamParameters", CAM_MODULE, _CAM_PARAMETERS, True)),
)
_CAM = (
    Member("header", header(RELEASE_1)),
    Member("cam", Record("CoopAwareness", CAM_MODULE, _AWARENESS)),
)
CAM = Record("CAM", CAM_MODULE, _CAM)
"""Cooperative awareness message of EN 302 637-2."""


def cams(
    senders: PositionVectors,
    acceleration_mps2: Float[ndarray, "n"],
    lwh_m: Float[ndarray, "n 3"],
) -> UInt8[ndarray, "n 41"]:
    """Cooperative awareness messages without low-frequency and special containers, one in each row.

    Parameters
    ----------
    senders
        The vehicles that send.
    acceleration_mps2
        Along the heading; NaN: unavailable.
    lwh_m
        Length, width and height of the sender.

    Raises
    ------
    ValueError
        In one line: a number out of range.
    """
    speed = np.asarray(senders.speed_mps, float)
    direction = np.where(np.isfinite(speed), (speed < 0).astype(np.int64), 2)
    motion = {
        "heading": {"value": senders.heading, "confidence": 127},
        "speed": {"value": up(np.abs(speed), 0.01, 0, 16382, 16383), "confidence": 127},
        "driveDirection": direction,
        "vehicleLength": {"value": up(lwh_m[:, 0], 0.1, 1, 1022), "confidence": 4},
        "vehicleWidth": up(lwh_m[:, 1], 0.1, 1, 61),
        "longitudinalAcceleration": {"value": up(acceleration_mps2, 0.1, -160, 160, 161), "confidence": 102},
        "curvature": {"value": 1023, "confidence": 7},
        "curvatureCalculationMode": 2,
        "yawRate": {"value": 32767, "confidence": 8},
    }
    basic = {
        "stationType": senders.station_type(),
        "referencePosition": place(senders.latitude, senders.longitude),
    }
    value = {
        "header": {"protocolVersion": PROTOCOL, "messageId": CAM_ID, "stationId": senders.station},
        "cam": {
            "generationDeltaTime": np.asarray(senders.time_ms) % 65536,
            "camParameters": {
                "basicContainer": basic,
                "highFrequencyContainer": ("basicVehicleContainerHighFrequency", motion),
            },
        },
    }
    return np.packbits(rows(CAM, value, len(speed)), axis=1)
