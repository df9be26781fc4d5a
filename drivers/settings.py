"""Base class of all sections of a configuration."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator


class Settings(BaseModel):
    """A section of a configuration: unknown keys and values of the wrong type are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @field_validator("*", mode="before")
    @classmethod
    def _is_of_its_kind(cls, value: object, info: ValidationInfo) -> object:
        """Refuse values that pydantic would convert: true to the number 1, an empty string to a directory."""
        annotation = cls.model_fields[str(info.field_name)].annotation
        kinds = (annotation, *get_args(annotation))
        if isinstance(value, bool) and bool not in kinds:
            raise ValueError("cannot be true or false")
        if value == "" and Path in kinds:
            raise ValueError("is empty; give a path, or remove the key")
        return value
