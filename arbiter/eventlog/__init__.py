"""The event log: writer, reader, codec, snapshot, replay."""
