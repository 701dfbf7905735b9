"""A site whose robots have a DBC of their own, see `site_robots.dbc`, and what maps it to ours."""

from pathlib import Path

from dbc.catalogue import GNSS_IMU_DBC, Catalogue, load

SITE_DBC = Path(__file__).with_name("site_robots.dbc")
SITE_MAPPING = Path(__file__).with_name("site_mapping.toml")
SITE_FILES = (SITE_DBC, GNSS_IMU_DBC)


def load_site() -> Catalogue:
    """The site's messages under our names."""
    return load(SITE_FILES, SITE_MAPPING)
