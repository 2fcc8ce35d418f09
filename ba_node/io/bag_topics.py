# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0
"""Choose the topics of a recording that are the inputs: by type, then by what belongs together.

Keyframes say which robot it is; of several the one with the input's name whose namespace has tracks too. All else comes
from their namespace, or from where no other robot is. Cameras are those whose frames the tracks name. Where that leaves
several, nothing is guessed: the user has to say.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from ba_node.measurements import CameraRig
from ba_node.messages.topics import CAMERAS, INPUT_TYPES, TOPICS

# Numbers of a camera that differ by less than this, relative or px, are the same: they may have gone through a text.
_SAME = 1e-3


class BagError(ValueError):
    """A recording that cannot be read or written: empty, truncated, not MCAP, without the topics that are needed."""


class EmptyBagError(BagError):
    """A file of a recording that is whole and holds no message, as a recorder may leave the last of several."""


@dataclass(frozen=True)
class TopicChoice:
    """What a user says about topics."""

    topics: Mapping[str, str] = field(default_factory=dict)  # input -> topic, for those that are not to be found
    namespace: str = ""  # only topics in this namespace; empty for any


def parse_topic(text: str) -> tuple[str, str]:
    """Return input and topic of NAME=TOPIC.

    Raises:
        BagError: there is no such input.
    """
    name, equals, topic = text.partition("=")
    if name not in INPUT_TYPES or not equals or not topic.strip("/"):
        raise BagError(f"--topic {text}: expected NAME=TOPIC, NAME being one of {', '.join(INPUT_TYPES)}")
    return name, absolute(topic)


def absolute(name: str) -> str:
    """Return a name as it stands in a recording."""
    return "/" + name.strip("/")


NO_CHOICE = TopicChoice()


@dataclass
class Chosen:
    """Topics that were taken, by input, and those that were left, with the reason."""

    taken: dict[str, str] = field(default_factory=dict)
    left: dict[str, str] = field(default_factory=dict)


class Chooser:
    """Chooses among the topics of one recording that have messages of the type of each input.

    ``frames_of`` tells the frames that the first messages of a topic name, ``content_of`` the cameras in the first one.
    """

    def __init__(
        self,
        found: Mapping[str, list[str]],
        frames_of: Callable[[str], frozenset[str]],
        content_of: Callable[[str], CameraRig | None],
    ) -> None:
        self._found = {name: sorted(found.get(name, [])) for name in INPUT_TYPES}
        self._frames_of = frames_of
        self._content_of = content_of
        self._robots = {_space(topic) for topic in self._found["keyframes"]} - {""}
        self._result = Chosen()

    def choose(self, choice: TopicChoice) -> Chosen:
        """Return what is taken and what is left.

        Raises:
            BagError: a topic that the user names is not there, or several are possible.
        """
        options = self._narrowed(choice)
        for name in INPUT_TYPES:
            if name == "camera_info" and "camera_rig" in self._result.taken:
                break
            if TOPICS[name].by_name and name not in choice.topics:
                options[name] = [topic for topic in options[name] if topic.rpartition("/")[2] == name]
            candidates = options[name] if name == "keyframes" or name in choice.topics else self._related(options[name])
            topic = self._pick(name, candidates, options)
            if topic:
                self._result.taken[name] = topic
        self._note_left()
        return self._result

    def _narrowed(self, choice: TopicChoice) -> dict[str, list[str]]:
        """Return the topics of each input that the user's words leave."""
        options = dict(self._found)
        space = absolute(choice.namespace) if choice.namespace.strip("/") else ""
        for name, topics in self._found.items():
            inside = [topic for topic in topics if topic.startswith(f"{space}/")]
            # Cameras that stand in no robot's namespace may be meant for each.
            shared = [topic for topic in topics if not self._of_a_robot(topic)] if name in CAMERAS else []
            options[name] = inside or shared
        for name, topic in choice.topics.items():
            if topic not in self._found[name]:
                there = ", ".join(self._found[name]) or "none"
                raise BagError(f"--topic {name}={topic}: no such topic of {INPUT_TYPES[name]}; there are: {there}")
            options[name] = [topic]
        if space and not options["keyframes"]:
            there = ", ".join(self._found["keyframes"]) or "none"
            raise BagError(f"--namespace {space}: no keyframes in it; there are: {there}")
        return options

    def _of_a_robot(self, topic: str) -> bool:
        return any(topic.startswith(f"{robot}/") for robot in self._robots)

    def _related(self, topics: list[str]) -> list[str]:
        """Return those that do not belong to the keyframes of another robot, those of the namespace first of all."""
        space = _space(self._result.taken.get("keyframes", ""))
        others = [robot for robot in self._robots if robot != space and not f"{space}/".startswith(f"{robot}/")]
        return [topic for topic in topics if not any(topic.startswith(f"{robot}/") for robot in others)]

    def _pick(self, name: str, topics: list[str], options: Mapping[str, list[str]]) -> str | None:
        space = _space(self._result.taken.get("keyframes", ""))
        narrowing: list[Callable[[str], bool]] = [lambda topic: topic.rpartition("/")[2] == name]
        if name == "keyframes":
            spaces = {_space(topic) for topic in options["feature_tracks"]}
            narrowing.append(lambda topic: _space(topic) in spaces)
        else:
            narrowing[:0] = [lambda topic: _space(topic) == space, lambda topic: topic.startswith(f"{space}/")]
        if name in CAMERAS:
            narrowing.insert(0, self._is_seen)
        for passes in narrowing:
            if len(topics) > 1:
                topics = [topic for topic in topics if passes(topic)] or topics
        if len(topics) > 1 and name in CAMERAS and self._agree(topics):
            topics = topics[:1]
        if len(topics) > 1:
            raise BagError(self._which(name, topics))
        return topics[0] if topics else None

    def _is_seen(self, topic: str) -> bool:
        """Return True if the tracks are in a frame of this camera or rig."""
        tracks = self._result.taken.get("feature_tracks")
        return bool(tracks and self._frames_of(tracks) & self._frames_of(topic))

    def _agree(self, topics: list[str]) -> bool:
        rigs = [self._content_of(topic) for topic in topics]
        return rigs[0] is not None and all(pickle.dumps(rig) == pickle.dumps(rigs[0]) for rig in rigs)

    def _which(self, name: str, topics: list[str]) -> str:
        shown = topics
        if name in CAMERAS:
            shown = [f"{topic} (frame {', '.join(sorted(self._frames_of(topic)))!r})" for topic in topics]
            tracks = self._result.taken.get("feature_tracks", "")
            frames = ", ".join(sorted(self._frames_of(tracks))) if tracks else ""
            shown.append(f"the tracks are in frame {frames!r}")
        text = f"cannot tell which {name} are meant: {', '.join(shown)}: say --topic {name}={topics[0]}"
        spaces = [_space(topic) for topic in topics]
        return f"{text} or --namespace {spaces[0]}" if spaces[0] and len(set(spaces)) == len(spaces) else text

    def _note_left(self) -> None:
        taken = set(self._result.taken.values())
        rig = self._result.taken.get("camera_rig")
        for name, topics in self._found.items():
            for topic in topics:
                if topic in taken:
                    continue
                reason = f"{self._result.taken.get(name, 'no other')} is taken as {name}"
                if TOPICS[name].by_name and name not in self._result.taken:
                    reason = f"not named {name}: say --topic {name}={topic} to use it"
                if name == "camera_info" and rig:
                    reason = f"{rig} tells the cameras{self._other_numbers(topic, rig)}"
                self._result.left[topic] = reason

    def _other_numbers(self, topic: str, rig: str) -> str:
        """Return in words where a lone camera is in the rig with other numbers."""
        lone, whole = self._content_of(topic), self._content_of(rig)
        if not isinstance(lone, CameraRig) or not isinstance(whole, CameraRig) or lone.malformed or whole.malformed:
            return ""
        for name, intrinsics in zip(whole.names, whole.intrinsics, strict=True):
            if name == lone.names[0] and not np.allclose(intrinsics, lone.intrinsics[0], rtol=_SAME, atol=_SAME):
                fx, expected = lone.intrinsics[0, 0], intrinsics[0]
                return f", with other numbers for {name!r}: fx = {expected:g} px where this says {fx:g}"
        return ""


def _space(topic: str) -> str:
    return topic.rpartition("/")[0]
