"""From what a camera sees to where a robot goes.

::

    calibration = fit_plane(camera_points, robot_points, touch_sigma=0.0002)
    result = await camera.trigger()
    for part in calibration.to_robot(result.value):
        ...

:func:`fit_plane` takes points that both have seen, :func:`fit_touches` the origin mark and touches
of the sheet's rays. The room knows points and poses, no sockets. It needs the extra
``calibration``.
"""

from smartcam.calibration.codes import Code, Remark
from smartcam.calibration.plane import Drift, PlaneCalibration, fit_plane
from smartcam.calibration.touches import fit_touches

__all__ = ["Code", "Drift", "PlaneCalibration", "Remark", "fit_plane", "fit_touches"]
