"""Events and shared values of a game as lines of text."""

from collections.abc import Mapping
from typing import Any

from client_sdk.view import View


def sentence(name: str, data: Any, view: View) -> str:
    """Returns an event as a sentence; an event that the window does not know is shown with its name and data."""
    figures = {figure.entity: figure for figure in view.figures}

    def called(entity: Any) -> str:
        figure = figures.get(entity)
        return str(figure.attributes.get("name", f"#{entity}")) if figure else "a player"

    match name, data:
        case "said", {"by": by, "text": text}:
            return f"{called(by)}: {text}"
        case "tagged", {"by": by, "who": who}:
            return f"{called(by)} tagged {called(who)}"
        case "out", {"by": by, "who": who}:
            return f"{called(by)} puts {called(who)} out"
        case "round", {"winner": str(winner)}:
            return f"{winner} wins the round"
        case "round", {"winner": winner}:
            return f"{called(winner)} wins the round"
    if isinstance(data, Mapping):
        named = {key: called(value) if key in ("by", "who") else value for key, value in data.items()}
        return name + "".join(f"  {key} {value}" for key, value in named.items())
    return f"{name} {'' if data is None else data}"


def points_text(points: Any) -> str:
    """Returns the shared value "points", a table of teams and their points, as a text; empty if there is none."""
    if not isinstance(points, Mapping):
        return ""
    return "".join(f"    {team} {count}" for team, count in points.items())
