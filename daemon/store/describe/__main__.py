"""`python -m daemon.store.describe schema|metadata [--store FILE]`: docs/reference/schema.md, Datasette's metadata."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from calibration.rig.description import shipped_rig
from daemon.store.describe.description import StoreDescription, describe_new, describe_store
from daemon.store.describe.pages import datasette_metadata, schema_page

EXAMPLE_RIG = "swdt82"


def example() -> StoreDescription:
    """Describe the store of the example rig, which the documentation shows."""
    rig = shipped_rig(EXAMPLE_RIG)
    joints = {joint.name: joint.unit for joint in rig.joints}
    signals = {channel.name: channel.unit for channel in rig.channels if channel.name not in joints}
    return describe_new(joints.items(), signals.items())


def main() -> None:
    """Print the page or the metadata."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("schema", "metadata"))
    parser.add_argument("--store", type=Path, help="of this store; of the example rig's by default")
    options = parser.parse_args()
    store = example() if options.store is None else describe_store(options.store)
    database = "rigcal" if options.store is None else options.store.stem
    sys.stdout.write(schema_page(store) if options.what == "schema" else datasette_metadata(store, database))


if __name__ == "__main__":
    main()
