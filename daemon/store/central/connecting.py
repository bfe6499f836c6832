"""Opening a central database: its address, its revision, and its errors in plain words."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sqlalchemy import Engine, create_engine, inspect, text
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, OperationalError, SQLAlchemyError

from daemon.errors import ConfigError, DatabaseOlderError, StoreError
from daemon.store.central.site_table import SITE
from daemon.store.revisions import (
    SCRIPTS,
    Advice,
    known_revisions,
    require_head,
    require_known,
)
from drivers.libraries import require_library

if TYPE_CHECKING:
    from alembic.config import Config
    from sqlalchemy import Connection

CONNECT_S = 10
ANSWER_S = 60
"""A server that says nothing for so long is away; what it was given is given again."""
CENTRAL_SCRIPTS = SCRIPTS / "central"


class CentralAwayError(StoreError):
    """The central database cannot be reached, or went away in the middle: try again later."""


@dataclass(frozen=True, slots=True)
class Central:
    """A central database that is this version's."""

    engine: Engine
    name: str
    """Its address without the password, for messages."""

    @contextmanager
    def transaction(self) -> Iterator[Connection]:
        """A transaction that is done when the block has ended, or has changed nothing.

        Raises CentralAwayError, StoreError.
        """
        with said_plainly(self.name), self.engine.begin() as connection:
            yield connection

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()


def open_central(url: str, password: str | None) -> Central:
    """Connect, and see that the tables are this version's.

    Raises ConfigError, MissingLibraryError, CentralAwayError, DatabaseNewerError,
    DatabaseOlderError.
    """
    central = connect_central(url, password)
    try:
        with central.transaction() as connection:
            known = known_revisions(CENTRAL_SCRIPTS)
            require_head(_revision(connection), central.name, known, _CENTRAL)
    except BaseException:
        central.close()
        raise
    return central


def connect_central(url: str, password: str | None) -> Central:
    """Give a central database that may have no tables yet. Raises as `open_central`."""
    require_library("psycopg", "central database")
    address = _address(url)
    if password is not None:
        address = address.set(password=password)
    engine = create_engine(
        address,
        pool_size=1,
        connect_args={
            "connect_timeout": CONNECT_S,
            "application_name": "dcam",
            # A dead line is found out, also one that only stays silent.
            "keepalives_idle": ANSWER_S // 2,
            "keepalives_interval": ANSWER_S // 6,
            "keepalives_count": 3,
            "tcp_user_timeout": ANSWER_S * 1000,
            "options": "-c TimeZone=UTC",
        },
    )
    return Central(engine, address.set(password=None).render_as_string())


def _address(url: str) -> URL:
    try:
        address = make_url(url)
    except ArgumentError:
        address = None
    if address is None or address.drivername not in {"postgresql", "postgres"}:
        msg = "fleet.url: must be an address such as postgresql://dcam@central.example/dcam"
        raise ConfigError(msg)
    return address.set(drivername="postgresql+psycopg")


@contextmanager
def said_plainly(name: str) -> Iterator[None]:
    """Turn SQLAlchemy's errors into the store's, which say what to do."""
    try:
        yield
    except DBAPIError as error:
        why = _reason(error)
        if isinstance(error, OperationalError) or error.connection_invalidated:
            msg = f"{name}: {why}"
            raise CentralAwayError(msg) from error
        msg = f"{name}: {why}: dcam-ctl sync --prepare, as its owner, sets tables and rights right"
        raise StoreError(msg) from error
    except SQLAlchemyError as error:
        msg = f"{name}: {error}"
        raise StoreError(msg) from error


def _reason(error: DBAPIError) -> str:
    """The first line of what the server or the driver says."""
    lines = str(error.orig).strip().splitlines()
    return " ".join(lines[0].split()) if lines else type(error.orig).__name__


def _revision(connection: Connection) -> str | None:
    tables = inspect(connection).get_table_names()
    if "alembic_version" not in tables:
        return None
    found = connection.scalar(text("SELECT version_num FROM alembic_version"))
    return None if found is None else str(found)


def _without_tables(place: object) -> StoreError:
    msg = f"{place}: has no tables of this program: run dcam-ctl sync --prepare as its owner"
    return DatabaseOlderError(msg)


_CENTRAL = Advice(
    "central revision",
    _without_tables,
    "run dcam-ctl sync --prepare as its owner; rows wait until then",
    lambda _place, _known: "install that version here; rows wait until then",
)


def prepare(central: Central) -> tuple[str | None, str]:
    """Make the tables, or bring them to this version's, in one transaction: revisions old and new.

    Raises DatabaseNewerError, CentralAwayError, StoreError.
    """
    from alembic import command

    known = known_revisions(CENTRAL_SCRIPTS)
    with central.transaction() as connection:
        connection.execute(text("SELECT pg_advisory_xact_lock(hashtext('dcam_prepare'))"))
        found = _revision(connection)
        if found is None and inspect(connection).has_table(SITE.name):
            msg = (
                f"{central.name}: holds tables of another program: give dcam a database of its own"
            )
            raise StoreError(msg)
        require_known(found, central.name, known, _CENTRAL)
        config = _alembic_config()
        config.attributes["connection"] = connection
        command.upgrade(config, "head")
    return found, known[-1]


def _alembic_config() -> Config:
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(CENTRAL_SCRIPTS).replace("%", "%%"))
    return config
