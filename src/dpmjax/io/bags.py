"""Bags of ROS 1 and ROS 2 by rosbags (extra `ros`): their topics, and messages by number in the order of time."""

from __future__ import annotations

import struct
import threading
import weakref
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from dpmjax.io.files import import_for, natural_key, refusing
from dpmjax.sequences import InputError, require

POINT_CLOUD, LASER_SCAN = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/LaserScan"
LIVOX_CLOUDS = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg")
MULTI_ECHO_SCAN = "sensor_msgs/msg/MultiEchoLaserScan"
_SUFFIXES = (".bag", ".mcap", ".db3")
_ADVICE = "copy the bag again, or repair it (rosbag reindex, ros2 bag reindex, mcap recover)"
# Advice for bags without scans of the wanted kind, by the types that they have.
_OTHER_KINDS = {
    ("LaserScan", "MultiEchoLaserScan"): "planar scans are mapped by dpmjax map2d",
    ("PointCloud2", "CustomMsg"): "clouds are mapped by dpmjax slam",
    ("VelodyneScan", "PacketMsg", "VelodynePacket", "RslidarPacket", "UdpFrame", "HesaiScan", "PandarScan"): (
        "raw packets are not read: play them through the driver and record its PointCloud2"
    ),
}


class Topic(NamedTuple):
    """A topic of a bag.

    Attributes:
        name: such as /points.
        kind: type of its messages, such as sensor_msgs/msg/PointCloud2.
        num_messages: number of messages.
    """

    name: str
    kind: str
    num_messages: int

    @property
    def short_kind(self) -> str:
        """The type without its package."""
        return self.kind.rpartition("/")[2]


class Place(NamedTuple):
    """Place of a message in a bag.

    Attributes:
        stamp_ns: time of its header, or of the recording where the headers of its topic have none, ns since 1970.
        recorded_ns: time of the recording, ns.
        number: number among the messages that were recorded at this time.
    """

    stamp_ns: int
    recorded_ns: int
    number: int


def is_bag(path: Path) -> bool:
    """Returns True for a bag of ROS: a file .bag, .mcap or .db3, or a folder of these."""
    return path.suffix.lower() in _SUFFIXES if path.is_file() else path.is_dir() and bool(_bag_files(path))


def _bag_files(path: Path) -> list[Path]:
    """Lists the files of a bag; the folder itself where it has ROS 2's metadata.yaml."""
    if not path.is_dir():
        return [path]
    if _names_ros2_files(path / "metadata.yaml"):
        return [path]
    parts = (sorted(path.glob(f"*{suffix}"), key=lambda file: natural_key(file.name)) for suffix in _SUFFIXES)
    return next((found for found in parts if found), [])


def _names_ros2_files(metadata: Path) -> bool:
    """Returns True for the list of files of a ROS 2 bag; another program's metadata.yaml lies beside its scans."""
    return metadata.is_file() and b"rosbag2_bagfile_information" in metadata.read_bytes()


class Bag:
    """An open bag, which is closed with its last reference.

    Args:
        path: a file .bag, .mcap or .db3, a folder of the parts of a bag, or a folder with metadata.yaml.

    Attributes:
        path: the path.
        topics: names, types and numbers of messages.

    Raises:
        InputError: no rosbags, or a bag that cannot be read.
    """

    def __init__(self, path: Path) -> None:
        highlevel = import_for(path, "rosbags.highlevel", "ros")
        typesys = import_for(path, "rosbags.typesys", "ros")
        self.path = path
        self._lock = threading.Lock()
        with _refusing(path):
            # A bag without definitions of its types has the standard ones.
            types = typesys.get_typestore(typesys.Stores.LATEST)
            self._reader: Any = highlevel.AnyReader(_bag_files(path), default_typestore=types)
            self._reader.open()
        weakref.finalize(self, self._reader.close)
        with _refusing(path):
            topics = self._reader.topics.items()
            self.topics = [Topic(name, str(info.msgtype), int(info.msgcount)) for name, info in topics]

    def of_kinds(self, kinds: Collection[str]) -> list[Topic]:
        """Finds the topics of these types that have messages."""
        return [each for each in self.topics if each.kind in kinds and each.num_messages > 0]

    def choose(self, kinds: Collection[str], topic: str | None, what: str) -> Topic:
        """Chooses the topic of scans.

        Args:
            kinds: types of messages that are read.
            topic: name given by the user; None: the only topic of these types.
            what: word for such messages.

        Returns:
            The topic.

        Raises:
            InputError: no such topic, one of another type, none at all, or several.
        """
        held = ", ".join(f"{each.name} ({each.short_kind})" for each in self.topics) or "none"
        fitting = self.of_kinds(kinds)
        if topic is not None:
            named = next((each for each in self.topics if each.name.strip("/") == topic.strip("/")), None)
            if named is None:
                raise InputError(self.path, f"no topic {topic}, it has {held}", "name one of those with --topic")
            found = f"topic {topic} has messages {named.kind} ({named.num_messages})"
            require(named in fitting, self.path, found, f"name a topic of {what}; the bag has {held}")
            return named
        present = {each.short_kind for each in self.topics}
        advices = (advice for others, advice in _OTHER_KINDS.items() if present.intersection(others))
        advice = next(advices, "record LaserScan, PointCloud2 or Livox's CustomMsg")
        require(len(fitting) > 0, self.path, f"no {what}; its topics are {held}", advice)
        names = ", ".join(each.name for each in fitting)
        require(len(fitting) == 1, self.path, f"{len(fitting)} topics of {what}: {names}", "name one with --topic")
        return fitting[0]

    def read(self, topic: str, place: Place) -> Any:
        """Reads a message.

        Args:
            topic: its topic.
            place: one of its `places`.

        Returns:
            The message of rosbags.

        Raises:
            InputError: the bag is damaged.
        """
        with self._lock, _refusing(self.path):
            found = list(self._messages(topic, start=place.recorded_ns, stop=place.recorded_ns + 1))
            connection, _, content = found[place.number]
            return self._reader.deserialize(content, connection.msgtype)

    def messages(self, topic: str) -> Iterator[Any]:
        """Reads all messages of a topic in the order of the recording.

        Args:
            topic: the name.

        Yields:
            The messages of rosbags.

        Raises:
            InputError: the bag is damaged.
        """
        with self._lock, _refusing(self.path):
            for connection, _, content in self._messages(topic):
                yield self._reader.deserialize(content, connection.msgtype)

    def _messages(self, topic: str, **times: int) -> Iterator[Any]:
        return self._reader.messages([each for each in self._reader.connections if each.topic == topic], **times)

    def places(self, topic: str) -> list[Place]:
        """Finds the messages of a topic.

        Args:
            topic: topic of messages that begin with a header.

        Returns:
            All messages in the order of the times of their headers.

        Raises:
            InputError: the bag is damaged.
        """
        places: list[Place] = []
        with self._lock, _refusing(self.path):
            seen: dict[int, int] = {}
            for _, recorded_ns, content in self._messages(topic):
                number = seen.get(recorded_ns, 0)
                seen[recorded_ns] = number + 1
                # The time of the header follows a number (ROS 1), or the encoding (ROS 2).
                order = ">" if self._reader.is2 and content[1] == 0 else "<"
                seconds, nanoseconds = struct.unpack_from(f"{order}II", content, 4)
                places.append(Place(seconds * 10**9 + nanoseconds, recorded_ns, number))
        if any(place.stamp_ns <= 0 for place in places):
            places = [place._replace(stamp_ns=place.recorded_ns) for place in places]
        return sorted(places)


def _refusing(path: Path) -> Any:
    """Turns all errors of rosbags on damaged bags into an `InputError`."""
    return refusing(path, "cannot be read as a bag of ROS ({kind}: {error})", _ADVICE, (Exception,))
