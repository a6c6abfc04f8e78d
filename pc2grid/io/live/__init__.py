"""Messages that arrive while they are used: of a running robot, or of a recording that is replayed.

A `feed.Feed` yields the bytes of messages with their topic, type and time (`foxglove_websocket`,
`live_log.Replay`). `live_log.LiveLog` turns them into scans, by the same decoders and the same choice of
topics as a recording. `live_log.open_live` is the way in; `nav2` publishes the results.
"""
