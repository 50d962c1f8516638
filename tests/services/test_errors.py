"""The walk from an error to all behind it ends, whatever way they lead to each other."""

import pytest

from amers.services.errors import (
    FormatError,
    InputError,
    MissingStatements,
    NotEnoughPoints,
    causes,
    causes_and_contexts,
    refuse_unstated,
    reword,
)


def linked(*names: str) -> dict[str, Exception]:
    """Errors by name."""
    return {name: RuntimeError(name) for name in names}


def names_of(error: BaseException) -> list[str]:
    """The errors of the walk from an error, each of which it meets once."""
    return sorted(str(one) for one in causes_and_contexts(error))


def test_a_chain_is_walked_from_the_error_to_its_first_cause():
    errors = linked("last", "middle", "first")
    errors["last"].__cause__, errors["middle"].__cause__ = errors["middle"], errors["first"]
    assert [str(one) for one in causes_and_contexts(errors["last"])] == ["last", "middle", "first"]


@pytest.mark.parametrize("link", ["__cause__", "__context__"])
@pytest.mark.parametrize("names", ["a", "ab", "abcde"])
def test_a_ring_is_walked_once(link: str, names: str):
    errors = linked(*names)
    for one, next_one in zip(names, names[1:] + names[:1], strict=True):
        setattr(errors[one], link, errors[next_one])
    assert names_of(errors["a"]) == list(names)


def test_an_error_that_was_raised_from_itself_still_leads_to_what_was_under_way():
    caught, under_way = RuntimeError("caught"), RuntimeError("under way")
    caught.__cause__, caught.__context__ = caught, under_way
    assert names_of(caught) == ["caught", "under way"]


def test_a_ring_behind_the_error_is_walked_once():
    errors = linked("error", "a", "b")
    errors["error"].__cause__ = errors["a"]
    errors["a"].__cause__, errors["b"].__context__ = errors["b"], errors["a"]
    assert names_of(errors["error"]) == ["a", "b", "error"]


def test_members_of_a_group_are_behind_it_and_so_is_what_caused_them():
    member, cause = RuntimeError("member"), RuntimeError("cause")
    member.__cause__ = cause
    group = ExceptionGroup("group", [member, RuntimeError("other")])
    cause.__context__ = group
    assert [str(one).partition(" (")[0] for one in causes_and_contexts(group)].count("group") == 1
    assert {"member", "other", "cause"} <= set(names_of(group))


def test_a_chain_longer_than_the_stack_is_walked():
    first = last = RuntimeError("0")
    for number in range(1, 20_000):
        last.__context__ = RuntimeError(str(number))
        last = last.__context__
    assert sum(1 for _ in causes_and_contexts(first)) == 20_000


def test_what_was_only_being_handled_is_no_cause():
    errors = linked("error", "cause", "handled")
    errors["error"].__context__, errors["error"].__cause__ = errors["handled"], errors["cause"]
    errors["cause"].__cause__ = errors["error"]
    assert [str(one) for one in causes(errors["error"])] == ["error", "cause"]


def test_all_that_is_not_stated_is_refused_together_and_one_by_itself():
    refuse_unstated([])
    alone, both = FormatError("no unit"), MissingStatements(["no datum", "no epoch"])
    with pytest.raises(FormatError, match=r"^no unit$"):
        refuse_unstated([alone])
    with pytest.raises(MissingStatements) as caught:
        refuse_unstated([both, alone])
    assert caught.value.missing == ("no datum", "no epoch", "no unit")
    reword(caught.value, str.upper)
    assert caught.value.missing == ("NO DATUM", "NO EPOCH", "NO UNIT")
    assert str(caught.value) == "3 STATEMENTS ARE MISSING: (1) NO DATUM; (2) NO EPOCH; (3) NO UNIT"
    one: InputError = MissingStatements(["no datum"])
    assert str(one) == "no datum"


def test_too_few_points_are_refused_with_their_numbers():
    assert str(NotEnoughPoints(3, 6)) == "3 usable points found, 6 needed"
    assert str(NotEnoughPoints(3, 6, "of ties")) == "3 usable points found, 6 needed: of ties"
