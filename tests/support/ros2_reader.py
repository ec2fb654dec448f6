"""A reader of ROS 2's topics that knows nothing of this project: its types are made of ROS's own message definitions.

`python ros2_reader.py DOMAIN SECONDS TYPE=TOPIC ...` prints each message as a line of JSON. It ends when each topic has
had a message and a line came on its stdin, or after SECONDS. What Cyclone decoded is encoded again and decoded by
rosbags, whose definitions are those of ROS 2.
"""

import dataclasses
import json
import select
import sys
import time
from typing import Any

import numpy as np
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlMeta, IdlStruct, types
from cyclonedds.idl.annotations import final
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

CONFIG = """<CycloneDDS><Domain><General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>120</MaxAutoParticipantIndex><Peers><Peer address="localhost"/></Peers></Discovery>
</Domain></CycloneDDS>"""
BASE = {"string": str, "bool": bool}
STORE = get_typestore(Stores.LATEST)
MADE: dict[str, Any] = {}


def dds_type(name: str) -> Any:
    """Make the DDS type of a ROS message, `pkg/msg/Name`, as rosidl names types and fields for DDS."""
    if name not in MADE:
        fields = {f"{field}_": field_type(definition) for field, definition in STORE.fielddefs[name][1]}
        package, _, last = name.split("/")
        body = {"__annotations__": fields, "__module__": __name__}
        made = IdlMeta(last, (IdlStruct,), body, typename=f"{package}::msg::dds_::{last}_")
        MADE[name] = final(dataclasses.dataclass(made))
    return MADE[name]


def field_type(definition: Any) -> Any:
    """Make the type of a field."""
    kind, what = definition
    if kind == Nodetype.BASE:
        return BASE.get(what[0]) or getattr(types, what[0])
    if kind == Nodetype.NAME:
        return dds_type(what)
    inner, size = what
    return types.array[field_type(inner), size] if kind == Nodetype.ARRAY else types.sequence[field_type(inner)]


def plain(value: Any) -> Any:
    """A message of rosbags as JSON has it."""
    if dataclasses.is_dataclass(value):
        names = [field.name for field in dataclasses.fields(value) if field.name != "__msgtype__"]
        return {name: plain(getattr(value, name)) for name in names}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(one) for one in value]
    return value.item() if isinstance(value, np.generic) else value


def main() -> None:
    """Receive, decode and print."""
    domain, seconds, *wanted = sys.argv[1:]
    _domain = Domain(int(domain), CONFIG)
    participant = DomainParticipant(int(domain))
    cdr = Policy.DataRepresentation(use_cdrv0_representation=True)
    qos = Qos(Policy.Reliability.Reliable(0), Policy.History.KeepLast(100), cdr)
    latched = Qos(Policy.Reliability.Reliable(0), Policy.History.KeepLast(1), Policy.Durability.TransientLocal, cdr)
    readers = {}
    for one in wanted:
        name, _, topic = one.partition("=")
        chosen = latched if topic.endswith(("tf_static", "path", "markers")) else qos
        readers[topic] = (
            name,
            DataReader(participant, Topic(participant, topic, dds_type(name), qos=chosen), qos=chosen),
        )
    print("ready", flush=True)
    until, heard, asked = time.monotonic() + float(seconds), set(), False
    while time.monotonic() < until and not (asked and heard == set(readers)):
        for topic, (name, reader) in readers.items():
            for message in reader.take(100):
                if isinstance(message, IdlStruct):
                    heard.add(topic)
                    again = STORE.deserialize_cdr(message.serialize(use_version_2=False), name)
                    print(json.dumps({"topic": topic, "type": name, **plain(again)}), flush=True)
        asked = asked or bool(select.select([sys.stdin], [], [], 0.02)[0])
    sys.exit(0 if heard == set(readers) else f"no message on {sorted(set(readers) - heard)}")


if __name__ == "__main__":
    main()
