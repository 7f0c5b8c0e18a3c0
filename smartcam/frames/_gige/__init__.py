"""GigE Vision cameras: control (GVCP), stream (GVSP) and the GenICam description of features.

Sans-I/O: :mod:`_gvcp`, :mod:`_gvsp`, :mod:`_assembler`, :mod:`_expressions`, :mod:`_description`,
:mod:`_features`. Sockets: :mod:`_control`, :mod:`_discovery`, :mod:`_stream`. On top: driver: :mod:`driver`.

Source: GigE Vision 2.0 (packets, bootstrap registers), GenICam GenApi 2.0 (description), SFNC
(names of features), PFNC (pixel formats); what a real peer says is aravis' fake camera, 0.8.26.
"""
