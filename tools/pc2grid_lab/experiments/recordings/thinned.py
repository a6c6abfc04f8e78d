"""A recording with fewer scans: only every nth message of its scans, everything else as it is."""

from __future__ import annotations

from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer

from pc2grid.io.atomic import replace_file


def write_thinned(source: Path, target: Path, every: int) -> None:
    """Write the MCAP file `target` with every nth message of each topic of scans in `source`.

    Raises OSError, and the errors of the `mcap` library.
    """
    with source.open("rb") as read, replace_file(target) as draft, draft.open("wb") as written:
        reader, writer = make_reader(read), Writer(written)
        header = reader.get_header()
        writer.start(profile=header.profile, library=header.library)
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        counts: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            number = counts[channel.id] = counts.get(channel.id, -1) + 1
            if schema is not None and schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    topic=channel.topic,
                    message_encoding=channel.message_encoding,
                    schema_id=0 if schema is None else schemas[schema.id],
                    metadata=channel.metadata,
                )
            is_scan = schema is not None and schema.name.split("/")[-1] in _SCANS
            if is_scan and number % every:
                continue
            writer.add_message(
                channel_id=channels[channel.id],
                log_time=message.log_time,
                data=message.data,
                publish_time=message.publish_time,
                sequence=message.sequence,
            )
        writer.finish()  # type: ignore[no-untyped-call]


_SCANS = ("PointCloud2", "PointCloud", "LaserScan", "Image", "CompressedImage")
