"""Messages that arrive while they are used: a running robot, a recording that is still being written.

A `Feed` hands over the bytes of messages with their topic, type and time, whatever they come through:
`recording_feed` and `standard_input` (both read by `mcap_tail`), `foxglove_websocket`, `zenoh_session`.
`live_log.LiveLog` turns any of them into scans, by the same decoders and the same choice of topics as a
finished recording. `targets.open_live` is the way in.
"""
