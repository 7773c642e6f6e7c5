"""Registration of a scan to the map and verification of the result: search and tracking both do it here."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import RegistrationConfig
from coview_stream.geometry.transforms import Points, Pose, transform
from coview_stream.localization.registration.local_map import LocalMap
from coview_stream.localization.registration.prepare_scan import RegistrationCloud
from coview_stream.localization.registration.register import register
from coview_stream.localization.registration.result import Prior, Registration
from coview_stream.localization.registration.verification import Evidence, RangeImage, verify


@dataclass(frozen=True)
class ScanInput:
    """A scan to be registered.

    Attributes:
        cloud: what is registered, odometry frame, metres.
        frame: (N, 3) float32 newest frame, body frame, metres: whose rays are held against the map.
        T_odom_body: (4, 4) odometry of that frame.
    """

    cloud: RegistrationCloud
    frame: Points
    T_odom_body: Pose

    @cached_property
    def range_image(self) -> RangeImage:
        """The newest frame by direction."""
        return RangeImage.of(self.frame)


@dataclass(frozen=True)
class ScanMatch:
    """A registration of a scan and, once it is asked for, its evidence.

    Attributes:
        registration: None where too few points found a partner.
        T_map_odom: (4, 4) as registered; where nothing was, the initial guess.
        scan: what was registered.
        target: the map around it.
        base_map: knows where it has been surveyed.
    """

    registration: Registration | None
    T_map_odom: Pose
    scan: ScanInput
    target: LocalMap
    base_map: BaseMap

    @cached_property
    def evidence(self) -> Evidence:
        """Shares of the scan that fit the map at ``T_map_odom``."""
        T, scan = self.T_map_odom, self.scan
        surveyed = self.base_map.surveyed(transform(T, scan.cloud.points)[:, :2])
        return verify(scan.cloud, T, scan.range_image, T @ scan.T_odom_body, self.target, surveyed)


def register_and_verify(
    base_map: BaseMap,
    scan: ScanInput,
    T_map_odom: Pose,
    target: LocalMap,
    config: RegistrationConfig,
    scales: tuple[float, ...],
    prior: Prior,
    moving: RegistrationCloud | None = None,
    iterations: int | None = None,
) -> ScanMatch:
    """Register a scan from an initial guess (eq. 13); the result brings its evidence.

    Args:
        base_map: the map.
        scan: what to register and verify.
        T_map_odom: (4, 4) initial guess.
        target: the map around it.
        config: of the registration.
        scales: largest correspondence distance of each scale, metres.
        prior: belief that takes part in the registration.
        moving: points to register in place of all of the scan's, for coarse scales.
        iterations: at most this many on each scale; default the configuration's.

    Raises:
        DependencyError: the method is GICP and small_gicp is missing.
    """
    centre = scan.T_odom_body[:3, 3]
    cloud = scan.cloud if moving is None else moving
    found = register(cloud, T_map_odom, target, config, scales, prior, centre, iterations)
    T = T_map_odom if found is None else found.T_map_source
    return ScanMatch(found, T, scan, target, base_map)
