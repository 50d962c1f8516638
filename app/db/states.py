"""The states of rows and other choices among words: types that need none of the tables."""

from typing import Literal

BlockState = Literal["staged", "published", "withdrawn"]
SceneState = Literal["uploading", "uploaded", "removed"]
JobState = Literal["accepted", "running", "successful", "failed", "dismissed"]
JobResponse = Literal["document", "raw"]
UploadPurpose = Literal["image", "model", "block"]
