"""Filters that end, freeze or confuse a parser that meets them unprotected."""

NAMED = {
    "3,900 unary minus signs overflow the stack": "-" * 3900 + "1 = saliency",
    "parentheses hide behind a backslash and a quotation mark": r"typology = '\' or "
    + "(" * 30
    + "saliency > 1"
    + ",2)" * 30
    + r" or typology = '\'",
    "parentheses hide between two escaped texts": r"typology = 'a\' and ("
    + "(" * 25
    + "1"
    + ",2)" * 25
    + r" or 'b\'' = ''",
    "lists in lists double the time with each level": "saliency in " + "(" * 25 + "1" + ",2)" * 25,
    "parentheses on a wrong filter double the time": "(" * 25 + "saliency = = 1" + ")" * 25,
    "a long list within ten lists": "saliency in " + "(" * 10 + "1" + ",1" * 1500 + ",2)" * 10,
    "a chain of 1,500 plus signs": "s_intersects(geometry, " + "1+" * 1500 + "1)",
    "a chain of 900 not": "s_intersects(geometry, " + "not " * 900 + "true)",
    "chains in each other": "s_intersects(geometry, " + "1+1-(" * 9 + "1" + ")" * 9 + "+1" * 20 + ")",
    "long chains in each other": "(1" + "+1" * 30 + "+" + ("(1" + "+1" * 30 + "+") * 8 + "1" + ")" * 9,
    "a chain of 1,900 equal signs": "1=" * 1900 + "1",
    "1,300 functions in each other": "f(" * 1300 + "1" + ")" * 1300,
    "geometries in each other": "GEOMETRYCOLLECTION(" * 190 + "POINT(1 2)" + ")" * 190,
    "signs in a geometry": "s_intersects(geometry, POINT(" + "-" * 3800 + "1 2))",
    "a difference in a geometry": "s_intersects(geometry, POINT(" + "1-" * 1800 + "1))",
    "a number that goes on as an operator": "1" + "or1" * 1300,
    "operators that go on as a name": "saliency" + " ora" * 990,
    "a text that does not end": "typology = '" + "''" * 1900,
    "parentheses in a quoted name": '"' + "(" * 30 + '" = 1 and ' + "(" * 30 + "1" + ")" * 30,
    "a quoted name with a quotation mark": '"a""' + "(" * 30 + '" = 1',
    "a number of 3,900 digits": "saliency = " + "1" * 3900,
    "a lone surrogate": "typology = '\ud800'",
}
"""Filters in text by what they do; all of them are refused."""
