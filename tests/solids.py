"""Upright boxes by Shapely. A box is x, y, z of its centre, length, width, height [m] and yaw [rad]."""

from shapely import box
from shapely.affinity import rotate, translate


def footprint(x, y, length, width, yaw):
    """The polygon that a box covers."""
    flat = rotate(box(-length / 2, -width / 2, length / 2, width / 2), yaw, (0, 0), use_radians=True)
    return translate(flat, x, y)


def iou(one, other):
    """Intersection over union of two boxes."""
    (x, y, z, *size, yaw), (x2, y2, z2, *size2, yaw2) = one, other
    length, width, height = size
    length2, width2, height2 = size2
    high = min(z + height / 2, z2 + height2 / 2) - max(z - height / 2, z2 - height2 / 2)
    flat = footprint(x, y, length, width, yaw).intersection(footprint(x2, y2, length2, width2, yaw2))
    common = flat.area * max(0.0, high)
    return common / (length * width * height + length2 * width2 * height2 - common)
