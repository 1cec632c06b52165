"""Descriptions of a study's arms: how a response becomes a command in each, and how each is trained."""

from __future__ import annotations

from collections.abc import Iterator

from animat.errors import counted
from animat.report.html import Table
from animat.studies.specification import Arm, Study

_MAPPINGS = {
    "1-threshold": "a response above the median gives the motor command +1, and one below it −1.",
    "9-thresholds": "a response gives one of ten motor commands from −1 to +1, depending on how many of nine "
    "thresholds it exceeds.",
    "linear": "the motor command rises linearly with the response, from −1 for the smallest response recorded to +1 "
    "for the largest.",
    "none": "there are no neurons, and policies give the motor commands themselves.",
}
_REFRESHED = "with shadowing: during training, each newer recording replaces the simulator of the neurons."
_SHADOWING: dict[bool | str, str] = {
    True: f"Trained {_REFRESHED}",
    False: "Trained without shadowing: on the simulator of the first recording throughout.",
    "drawn": "In training, each episode draws one of the recordings and uses its simulator.",
}
_FIXED = "percentiles are those of the first recording throughout."
_SHUFFLED = "the delivered stimulus is drawn at random, whatever the policy chooses."


def summarise_arms(study: Study) -> str:
    """What an arm is, then how many arms and policies there are, in a sentence that the caller ends."""
    are, policies = "is" if len(study.arms) == 1 else "are", counted(study.policies, "policy", "policies")
    return f"An arm is one way to train policies. There {are} {counted(len(study.arms), 'arm')} with {policies} each"


def describe_mapping(arm: Arm) -> str:
    """How a response becomes a command in an arm: a sentence without its capital."""
    return _MAPPINGS.get(arm.mapping, f"responses become motor commands by the mapping {arm.mapping}.")


def arm_differences(first: Arm, second: Arm) -> Iterator[str]:
    """A sentence for each setting in which two arms differ, except for whether they are trained."""
    for arm, other in ((first, second), (second, first)):
        refreshed = arm.shadowing if arm.trained and arm.through_neurons else False
        if refreshed is True is not other.shadowing:
            yield f"“{arm.name}” is trained {_REFRESHED}"
        if refreshed == "drawn" != other.shadowing:
            yield f"In “{arm.name}” each episode of training draws one of the recordings and uses its simulator."
        if arm.percentiles == "first" != other.percentiles:
            yield f"In “{arm.name}” {_FIXED}"
        if arm.delivery == "shuffled" != other.delivery:
            yield f"In “{arm.name}” {_SHUFFLED}"
        if arm.mapping != other.mapping:
            yield f"In “{arm.name}” {describe_mapping(arm)}"


def arms_table(study: Study) -> Table:
    """Each arm with its description."""
    rows = tuple((arm.name, " ".join(_describe(arm))) for arm in study.arms)
    note = "Commands are the robot's, from −1 to +1. Medians and thresholds are percentiles of the recorded responses."
    return Table("The arms", ("arm", "description"), rows, note=note)


def _describe(arm: Arm) -> Iterator[str]:
    if not arm.trained:
        yield "New networks, as they are before training."
    yield capitalised(describe_mapping(arm))
    if arm.through_neurons and arm.trained:
        yield _SHADOWING[arm.shadowing]
    if arm.delivery == "shuffled":
        yield f"{capitalised(_SHUFFLED[:-1])}, in training and in evaluation."
    if arm.percentiles == "first":
        yield capitalised(_FIXED)


def capitalised(text: str) -> str:
    """The text with a capital at its beginning; names in it keep their own."""
    return text[:1].upper() + text[1:]
