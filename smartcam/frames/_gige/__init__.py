"""GigE Vision cameras: control (GVCP), stream (GVSP) and the GenICam description of features.

Without sockets and clocks: :mod:`_gvcp`, :mod:`_gvsp`, :mod:`_block`, :mod:`_assembler`,
:mod:`_description`, :mod:`_expressions`, :mod:`_features`, :mod:`_messages`, :mod:`_triggering`.
With them: :mod:`_control`, :mod:`_discovery`, :mod:`_stream`, :mod:`_event_channel`,
:mod:`_force_address`; then :mod:`_session`, :mod:`_setup`, :mod:`_device_features` and
:mod:`driver`.

Source: GigE Vision 2.0 (packets, bootstrap registers), GenICam GenApi 2.0 (description), SFNC
(names of features), PFNC (pixel formats); the behaviour of a real peer is that of Aravis' fake
camera, 0.8.26.
"""
