"""The source of a domain's demonstrations: its demonstrator makes them, Minari keeps them."""

from collections.abc import Callable

from leapjax.data.storage.datasets import check_writable, dataset_id, exists
from leapjax.data.storage.reading import load, reasons
from leapjax.data.storage.writing import save
from leapjax.domain import Collection, Domain, Source
from leapjax.errors import UserError


def source(domain: Domain, count: int, seed: int) -> Source:
    """Returns a source of `count` demonstrations of a domain for a training seed.

    The domain's demonstrator makes them once; a Minari data set keeps them.
    """

    def make(name: str, progress: Callable[[int], None]) -> str:
        check_writable()
        if domain.collect is None:
            raise UserError(no_demonstrator(domain))
        collection = domain.collect(count, seed, progress)
        dropped = reasons(collection)
        summary = f"{count} demonstrations of {domain.level}"
        summary += f"; dropped: {dropped}" if dropped else ""
        save(name, collection, domain, summary)
        return summary

    def load_all(name: str, seed: int) -> Collection:
        del seed
        loaded = load(name, domain, count)
        found, dropped = len(loaded.demonstrations), reasons(loaded)
        if found < count:
            also = f" that can be used ({dropped})" if dropped else ""
            raise UserError(
                f"{name} has {found} episodes{also}, fewer than {count}: ask for {found}",
                "demos",
            )
        return loaded

    default = dataset_id(domain, count, seed)
    return Source(default, exists, make, load_all, count, "demonstrations")


def no_demonstrator(domain: Domain) -> str:
    """Returns the message for a domain that has no demonstrator."""
    return f"{domain.level} has no demonstrator: name a Minari data set of it to train on"
