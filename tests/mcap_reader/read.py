"""Reads an MCAP file with the packages of its makers and prints as JSON what is in it: counts and
schemas by topic, metadata, and of the topics named on the command line every message."""

import json
import sys

from google.protobuf.json_format import MessageToDict
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

topics = {}
wanted = set(sys.argv[2:])
with open(sys.argv[1], "rb") as file:
    reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
    summary = reader.get_summary()
    for schema, channel, message, decoded in reader.iter_decoded_messages():
        one = topics.setdefault(
            channel.topic, {"count": 0, "schema": schema.name, "messages": []}
        )
        one["count"] += 1
        # Every field of every message is decoded, wanted or not.
        fields = MessageToDict(decoded, preserving_proto_field_name=True)
        if channel.topic in wanted:
            one["messages"].append(
                {
                    "sequence": message.sequence,
                    "log_time": message.log_time,
                    "fields": fields,
                }
            )
    metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    attachments = [attachment.name for attachment in reader.iter_attachments()]

json.dump(
    {
        "message_count": summary.statistics.message_count,
        "topics": topics,
        "metadata": metadata,
        "attachments": attachments,
    },
    sys.stdout,
)
