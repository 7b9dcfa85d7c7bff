"""What the parts of the files are made of that a run keeps."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from ddco_pyro.spec.messages import invalid


def _not_null(value: Any) -> Any:
    if value is None:
        raise invalid(("", "must not be null; where there is none the key is left out"))
    return value


NOT_NULL = AfterValidator(_not_null)
Finite = Annotated[float, Field(allow_inf_nan=False)]
AtLeastOne = Annotated[int, Field(ge=1)]


class Record(BaseModel):
    """Part of such a file."""

    model_config = ConfigDict(extra="allow", frozen=True)
