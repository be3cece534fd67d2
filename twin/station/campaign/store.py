"""Where results stay: a folder of Parquet parts, one for each finished job, written so that none is ever half there."""

import json
import os
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from twin.plant.errors import InputError, RunError

CAMPAIGN, PARTS, CASES = "campaign.json", "parts", "cases.parquet"


class Store:
    """Results of one campaign in a folder.

    Parameters
    ----------
    folder
        Made if it is not there; one that holds another campaign is refused.
    name, fingerprint
        Of the campaign.

    Raises
    ------
    InputError
        If the folder holds something else, or cannot be written.
    """

    def __init__(self, folder: Path, name: str, fingerprint: str) -> None:
        self.folder = folder
        mark = folder / CAMPAIGN
        try:
            if mark.is_file():
                known = json.loads(mark.read_text(encoding="utf-8")).get("fingerprint")
                if known != fingerprint:
                    raise InputError(
                        f"{folder}: holds the results of another campaign ({known}); choose another folder with --out, "
                        "or delete it"
                    )
            elif folder.exists() and any(folder.iterdir()):
                raise InputError(
                    f"{folder}: is there already and holds no campaign; choose another with --out"
                )
            (folder / PARTS).mkdir(parents=True, exist_ok=True)
            text = json.dumps({"name": name, "fingerprint": fingerprint}, indent=2)
            _replace(mark, lambda path: path.write_text(text + "\n", encoding="utf-8"))
        except (OSError, ValueError, AttributeError) as error:
            raise InputError(
                f"{folder}: cannot be used for results ({error}); choose another with --out"
            ) from error

    def done(self) -> dict[int, int]:
        """Numbers of the jobs that are kept, with their numbers of rows; parts that cannot be read are left out."""
        found = {}
        for path in sorted((self.folder / PARTS).glob("part-*.parquet")):
            try:
                found[int(path.stem.removeprefix("part-"))] = pq.read_metadata(path).num_rows
            except (OSError, ValueError, pa.ArrowInvalid):
                continue
        return found

    def keep(self, job: int, rows: list[dict[str, Any]]) -> None:
        """Write the rows of a job.

        Raises
        ------
        RunError
            If they cannot be written.
        """
        path = self.folder / PARTS / f"part-{job:06d}.parquet"
        try:
            _replace(path, lambda to: pq.write_table(_table(rows), to))
        except OSError as error:
            raise RunError(f"{path}: cannot be written ({error.strerror or error})") from error

    def rows(self) -> list[dict[str, Any]]:
        """All rows kept so far, in order of their jobs."""
        out: list[dict[str, Any]] = []
        for job in sorted(self.done()):
            out += pq.read_table(self.folder / PARTS / f"part-{job:06d}.parquet").to_pylist()
        return out

    def gather(self, rows: list[dict[str, Any]]) -> Path:
        """Write all rows into one file beside the parts; returns its path."""
        path = self.folder / CASES
        try:
            _replace(path, lambda to: pq.write_table(_table(rows), to))
        except OSError as error:
            raise RunError(f"{path}: cannot be written ({error.strerror or error})") from error
        return path


def _table(rows: list[dict[str, Any]]) -> pa.Table:
    """Columns with the types of their values; one that is empty throughout is of numbers."""
    columns: dict[str, pa.Array] = {}
    for name in rows[0]:
        values = [row[name] for row in rows]
        known = next((v for v in values if v is not None), None)
        kind = (
            pa.bool_() if isinstance(known, bool)
            else pa.int64() if isinstance(known, int)
            else pa.string() if isinstance(known, str)
            else pa.float64()
        )  # fmt: skip
        columns[name] = pa.array(values, kind)
    return pa.table(columns)


def _replace(path: Path, write: Any) -> None:
    """Write beside the file and move it into place: a reader finds the old one or the new one, whole."""
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        write(beside)
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)
