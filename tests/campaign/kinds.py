"""Every kind of file that is read: a small valid one, what reads it, and which public
readers take part.

`KINDS` is the registry. A new public reader needs a kind here: `test_doors` compares.
"""

from tests.campaign.kind import Kind
from tests.campaign.of_cameras import cameras, tensors
from tests.campaign.of_results import conform_inputs, documents, results
from tests.campaign.of_splats import scenes, splats, values

_FAMILIES = (
    splats,
    scenes,
    values,
    cameras,
    tensors,
    results,
    documents,
    conform_inputs,
)
KINDS: dict[str, Kind] = {kind.name: kind for family in _FAMILIES for kind in family()}
