# SPDX-License-Identifier: Apache-2.0
"""Tables of whole numbers, coded by what their neighbours let expect: rANS in lanes, with integers alone.

A table has C columns of n numbers; row i follows row i - 1 in space. A number is told by its residual: it, less a
linear prediction from its neighbours (two rows before it, and two columns to its left). Which residuals are likely
depends on how large the neighbours' residuals were. Frequencies and weights are part of the stream, as whole numbers;
nothing here or in a reader rounds, so that a reader in another language finds the same numbers to the bit.

The coder is range ANS (Duda, arXiv 1311.2540) with states of 32 bits, words of 16 and frequencies of 14, interleaved
as by Giesen (arXiv 1402.3392): all lanes take a step at once, which is what makes it quick in numpy. It writes

    bytes
    4 L    a state for each of the L lanes, uint32, >= 2^16
           words, uint16, to the end of the stream

L is the smallest power of two that is at least C n / 2048, but no more than 1024; S = ceil(n / L). Lane l has the rows
from l S to l S + S - 1, as far as there are so many. Columns are coded one after the other; of a column, step
t = 0, ..., S - 1 codes row l S + t of each lane that has one: the first ceil((n - t) / S) lanes. The model has, for
each column in turn,

    numbers
    1       1: the column is signed and predicted; 0: it is neither
    7       weights w0, ..., w6 of the prediction, in 1/256
    4       shares s1, ..., s4 of the neighbours in the activity
    1 + K   K < 16, and K thresholds, rising
            for each of the K + 1 contexts: the first token that occurs, how many tokens follow with it, and their
            frequencies, which sum up to 2^14. Other tokens have frequency 0

x(i, c) is the number in row i and column c, and t(i, c) its token; both are 0 outside of the table, and before a lane's
first row. The activity is s1 t(i-1, c) + s2 t(i-2, c) + s3 t(i, c-1) + s4 t(i, c-2), with rows i-1 and i-2 of the same
lane; the context k is how many thresholds are not above it. In a step, each lane with a row, in turn, takes its token
from its state X:

    slot = X mod 2^14
    token: the one with start <= slot < start + frequency, in context k; start is the sum of smaller tokens' frequencies
    X = frequency (X div 2^14) + slot - start
    if X < 2^16: X = 2^16 X + the next word

Tokens below 32 are the number u itself. Token 32 + 4 e + m stands for u from (4 + m) 2^b on, 2^b of them, b = e + 3;
which, the b low bits say. After all lanes have their token, each lane whose token is 32 or more takes the lower
min(b, 16) of these bits, and after that, each takes the others, if there are any; r bits at once are

    bits = X mod 2^r,   X = X div 2^r,   if X < 2^16: X = 2^16 X + the next word

In a column that is not signed, x = u. In a signed one, x is the prediction plus 0, -1, 1, -2, 2, ... for
u = 0, 1, 2, 3, 4, ...; the prediction is, rounded down,

    (128 + w0 + w1 x(i-1, c) + w2 x(i-2, c) + w3 x(i, c-1) + w4 x(i-1, c-1) + w5 x(i, c-2) + w6 x(i-1, c-2)) div 256

At the end every state is 2^16 and no word is left: a reader checks it.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

Array = np.ndarray

PRECISION = 14
"""Bits of a frequency: those of a context sum up to 2^14."""
LOWEST = 1 << 16
"""Smallest state."""
WORD = 16
MOST_LANES = 1024
SYMBOLS_OF_A_LANE = 2048
DIRECT = 32
"""Residuals with a token of their own; larger ones share one with those that begin with the same three bits."""
TOKENS = DIRECT + 4 * 27
CONTEXTS = (1, 2, 3, 4, 6, 8, 12)
"""Numbers of contexts that an encoder tries for a column."""
MOST_CONTEXTS = 16
BITS_OF_A_FREQUENCY = 10
"""Cost of a frequency in a stream, about."""
ACTIVITY = 4
"""Neighbours whose tokens say how large a residual is going to be."""
LARGEST_SHARE = 16
MOST_ACTIVITY = ACTIVITY * LARGEST_SHARE * (TOKENS - 1)
SHIFT = 8
"""Fractional bits of a prediction's weights."""
PREDICTORS = 6
LARGEST_WEIGHT = 1 << 16
LARGEST = 1 << 32
NO_PREDICTION: tuple[list[int], Array | int] = [0] * (1 + PREDICTORS), 0
MOST_MODEL = 2 + PREDICTORS + ACTIVITY + 1 + MOST_CONTEXTS * (3 + TOKENS)
"""Numbers that describe a column."""


class BadStream(ValueError):
    """A stream that no encoder wrote."""


class _Lanes:
    """A table [C, n] in the order in which it is coded: [C, S, lanes], with zeros behind the last row."""

    def __init__(self, columns: int, rows: int):
        wanted = -(-columns * rows // SYMBOLS_OF_A_LANE)
        self.columns, self.rows = columns, rows
        self.lanes = min(1 << max(wanted - 1, 0).bit_length(), MOST_LANES)
        self.steps = -(-rows // self.lanes)

    def laid(self, table: Array) -> Array:
        padded = np.zeros((len(table), self.steps * self.lanes), dtype=np.int64)
        padded[:, : self.rows] = table
        return np.ascontiguousarray(padded.reshape(len(table), self.lanes, self.steps).transpose(0, 2, 1))

    def taken_up(self, laid: Array) -> Array:
        return laid.transpose(0, 2, 1).reshape(len(laid), self.lanes * self.steps)[:, : self.rows]

    def active(self, step: int) -> int:
        """Number of lanes that have a row in a step, always the first ones."""
        return -(-(self.rows - step) // self.steps)


def _before(values: Array, count: int) -> Array:
    """[S, lanes], `count` steps later; zeros come first."""
    out = np.zeros_like(values)
    out[count:] = values[: len(values) - count] if count < len(values) else 0
    return out


def _from_left(laid: Array, column: int) -> list[Array]:
    """The predictors in each of the two columns to the left: the same row, and the row before it."""
    zero = np.zeros_like(laid[0])
    inputs = []
    for left in (column - 1, column - 2):
        inputs += [laid[left], _before(laid[left], 1)] if left >= 0 else [zero, zero]
    return inputs


# ---- encoding


def encode_table(table: Array, signed: Array | bool = True) -> tuple[Array, bytes]:
    """A table as its model and its words.

    Args:
        table: whole numbers, |x| < 2^31; from 0 to 2^32 - 1 in columns that are not signed. [C, n]
        signed: whether numbers of a column are predicted and may be negative; others are as they are.

    Returns:
        the model, int32 numbers, and the coder's bytes.
    """
    columns, rows = table.shape
    lanes = _Lanes(columns, rows)
    laid = lanes.laid(table.astype(np.int64))
    signed = np.broadcast_to(signed, columns)
    real = lanes.laid(np.ones((1, rows)))[0].astype(bool)
    tokens, spares, lows, contexts = (np.zeros_like(laid) for _ in range(4))
    model: list[int] = []
    frequencies = []
    for column in range(columns):
        weights, prediction = _fitted_prediction(laid, column, real) if signed[column] else NO_PREDICTION
        if np.abs(laid[column] - prediction).max(initial=0) >= LARGEST >> 1:
            weights, prediction = NO_PREDICTION
        residuals = laid[column] - prediction
        unsigned = np.where(residuals < 0, -2 * residuals - 1, 2 * residuals) if signed[column] else residuals
        unsigned = np.where(real, unsigned, 0)
        bits = np.frexp(np.maximum(unsigned, 1).astype(np.float64))[1].astype(np.int64) - 1
        spares[column] = np.where(unsigned < DIRECT, 0, bits - 2)
        far = DIRECT + 4 * (bits - 5) + ((unsigned >> spares[column]) & 3)
        tokens[column] = np.where(unsigned < DIRECT, unsigned, far)
        lows[column] = unsigned & ((1 << spares[column]) - 1)
        shares, thresholds, contexts[column] = _fitted_contexts(tokens, column, real)
        model += [int(signed[column]), *weights, *shares, len(thresholds), *thresholds]
        table = []
        for context in range(len(thresholds) + 1):
            counts = np.bincount(tokens[column][real & (contexts[column] == context)], minlength=TOKENS)
            table.append(_normalised(counts))
            used = np.flatnonzero(table[-1])
            first, last = int(used[0]), int(used[-1])
            model += [first, last - first + 1, *map(int, table[-1][first : last + 1])]
        frequencies.append(np.array(table))
    return np.array(model, dtype=np.int32), _coded(lanes, frequencies, contexts, tokens, spares, lows)


def _fitted_prediction(laid: Array, column: int, real: Array) -> tuple[list[int], Array]:
    """Least squares, in 1/2^SHIFT."""
    values = laid[column]
    inputs = [_before(values, 1), _before(values, 2), *_from_left(laid, column)]
    matrix = np.stack([np.ones_like(values), *inputs])[:, real].astype(np.float64)
    gram = matrix @ matrix.T
    ridge = 1e-6 * np.trace(gram) / len(gram) + 1e-9
    fit = np.linalg.solve(gram + ridge * np.eye(len(gram)), matrix @ values[real].astype(np.float64))
    weights = np.rint(fit * (1 << SHIFT)).clip(-LARGEST_WEIGHT, LARGEST_WEIGHT).astype(np.int64)
    total = weights[0] + (1 << (SHIFT - 1))
    for weight, neighbours in zip(weights[1:], inputs, strict=True):
        total = total + weight * neighbours
    return weights.tolist(), total >> SHIFT


def _fitted_contexts(tokens: Array, column: int, real: Array) -> tuple[list[int], list[int], Array]:
    """Shares of the neighbours' tokens in the activity, its thresholds, and each number's context."""
    own = tokens[column]
    zero = np.zeros_like(own)
    neighbours = [_before(own, 1), _before(own, 2)]
    neighbours += [tokens[column - k] if column >= k else zero for k in (1, 2)]
    matrix = np.stack([np.ones_like(own), *neighbours])[:, real].astype(np.float64)
    gram = matrix @ matrix.T
    fit = np.linalg.solve(gram + 1e-6 * np.eye(5) * (1 + np.trace(gram)), matrix @ own[real].astype(np.float64))[1:]
    shares = np.rint(LARGEST_SHARE * fit.clip(0, None) / max(fit.max(), 1e-9)).astype(np.int64).clip(0, LARGEST_SHARE)
    activity = sum(share * values for share, values in zip(shares, neighbours, strict=True))
    counts = np.bincount((activity * TOKENS + own)[real], minlength=(MOST_ACTIVITY + 1) * TOKENS)
    counts = counts.reshape(MOST_ACTIVITY + 1, TOKENS)
    levels = np.flatnonzero(counts.any(axis=1))
    below = np.concatenate([np.zeros((1, TOKENS), dtype=np.int64), np.cumsum(counts[levels], axis=0)])
    share = below.sum(axis=1) / max(below[-1].sum(), 1)
    firsts, least = [0], np.inf
    for count in CONTEXTS:
        tried = np.unique(np.searchsorted(share[:-1], np.arange(count) / count)) if len(levels) else np.zeros(1, int)
        tried = tried[tried < max(len(levels), 1)]
        bits = _bits(np.diff(below[[*tried, len(levels)]], axis=0))
        if bits < least:
            firsts, least = tried, bits
    thresholds = levels[firsts[1:]]
    return shares.tolist(), thresholds.tolist(), np.searchsorted(thresholds, activity, side="right")


def _bits(counts: Array) -> float:
    """Estimated cost of tokens by their counts in each context [K, TOKENS], and of the contexts' frequencies."""
    totals = counts.sum(axis=1, keepdims=True).clip(1)
    entropy = -(counts * np.log2(np.where(counts > 0, counts / totals, 1.0))).sum()
    return float(entropy + BITS_OF_A_FREQUENCY * (counts > 0).sum())


def _normalised(counts: Array) -> Array:
    """Frequencies that sum up to 2^PRECISION, at least 1 where there is a count."""
    total = 1 << PRECISION
    if counts.sum() == 0:
        counts = np.eye(1, len(counts), dtype=np.int64)[0]
    shares = np.where(counts > 0, np.maximum(np.rint(counts * (total / counts.sum())), 1), 0).astype(np.int64)
    while (over := int(shares.sum()) - total) != 0:  # from the most frequent, which it costs least
        largest = int(shares.argmax())
        shares[largest] -= min(over, int(shares[largest]) - 1) if over > 0 else over
    return shares


def _coded(
    lanes: _Lanes, frequencies: list[Array], contexts: Array, tokens: Array, spares: Array, lows: Array
) -> bytes:
    state = np.full(lanes.lanes, LOWEST, dtype=np.uint64)
    chunks: list[Array] = []

    def push(x: Array, limit: Array) -> Array:
        """Words out of the lanes whose state is not below the limit."""
        out = x >= limit
        if out.any():
            chunks.append((x[out] & np.uint64(0xFFFF)).astype("<u2"))
            x = np.where(out, x >> np.uint64(WORD), x)
        return x

    for column in reversed(range(lanes.columns)):
        table = frequencies[column]
        starts = np.cumsum(table, axis=1) - table
        f = table[contexts[column], tokens[column]].astype(np.uint64)
        start = starts[contexts[column], tokens[column]].astype(np.uint64)
        limits = f << np.uint64(32 - PRECISION)
        most = spares[column].max(axis=1)
        for step in reversed(range(lanes.steps)):
            count = lanes.active(step)
            x = state[:count]
            if most[step] > 0:
                spare, low = spares[column, step, :count], lows[column, step, :count]
                for shift in (WORD, 0) if most[step] > WORD else (0,):  # the lower 16 bits are read first
                    bits = (spare - shift).clip(0, WORD).astype(np.uint64)
                    x = push(x, np.uint64(1) << (np.uint64(32) - bits))
                    x = (x << bits) | ((low >> shift).astype(np.uint64) & ((np.uint64(1) << bits) - np.uint64(1)))
            fs = f[step, :count]
            x = push(x, limits[step, :count])
            quotient = x // fs
            x = (quotient << np.uint64(PRECISION)) + (x - quotient * fs) + start[step, :count]
            state[:count] = x
    return state.astype("<u4").tobytes() + b"".join(chunk.tobytes() for chunk in reversed(chunks))


# ---- decoding


def decode_table(model: Array, data: bytes, columns: int, rows: int) -> Array:
    """The table that `encode_table` was given, int64 [C, n].

    Raises:
        BadStream: the model is none, or words are missing or left over.
    """
    lanes = _Lanes(columns, rows)
    if len(data) < 4 * lanes.lanes or len(data) % 2:
        raise BadStream("too few bytes for its lanes")
    state = np.frombuffer(data, "<u4", lanes.lanes).astype(np.int64)
    words = np.frombuffer(data, "<u2", offset=4 * lanes.lanes).astype(np.int64)
    if (state < LOWEST).any():
        raise BadStream("a state is too small")
    laid = np.zeros((columns, lanes.steps, lanes.lanes), dtype=np.int64)
    tokens = np.zeros((3, lanes.steps, lanes.lanes), dtype=np.int64)  # of this column, and of the two to the left
    at = 0
    mask = (1 << PRECISION) - 1
    for column, part in enumerate(_read_model(model, columns)):
        own, out = tokens[column % 3], laid[column]
        base = part.weights[0] + (1 << (SHIFT - 1))
        for weight, values in zip(part.weights[3:], _from_left(laid, column), strict=True):
            base = base + weight * values
        base = np.broadcast_to(base, out.shape)
        activity = np.zeros_like(own)
        for left, share in ((1, part.shares[2]), (2, part.shares[3])):
            if column >= left:
                activity += share * tokens[(column - left) % 3]
        first, second = part.weights[1:3]
        share_1, share_2 = part.shares[:2]
        zero = np.zeros(lanes.lanes, dtype=np.int64)
        before, before_2, token_1, token_2 = zero, zero, zero, zero
        for step in range(lanes.steps):
            count = lanes.active(step)
            x = state[:count]
            slot = x & mask
            if part.contexts > 1:
                likely = activity[step] + share_1 * token_1 + share_2 * token_2
                slot += part.first_slot.take(likely[:count])
            token = part.tokens.take(slot)
            x = part.frequencies.take(slot) * (x >> PRECISION) + part.offsets.take(slot)
            x, at = _refilled(x, words, at)
            unsigned = token
            if (far := (token >= DIRECT).nonzero()[0]).size:
                large = token[far] - DIRECT
                spare, low, rest = (large >> 2) + 3, np.zeros_like(large), x[far]
                for shift in (0, WORD) if spare.max() > WORD else (0,):
                    bits = (spare - shift).clip(0, WORD)
                    low += (rest & ((1 << bits) - 1)) << shift
                    rest, at = _refilled(rest >> bits, words, at)
                x[far] = rest
                unsigned = token.copy()
                unsigned[far] = ((4 + (large & 3)) << spare) + low
            state[:count] = x
            if part.signed:
                value = np.zeros(lanes.lanes, dtype=np.int64)
                expected = (base[step, :count] + first * before[:count] + second * before_2[:count]) >> SHIFT
                value[:count] = expected + ((unsigned >> 1) ^ -(unsigned & 1))
                out[step] = value
                before, before_2 = value, before
            else:
                out[step, :count] = unsigned
            own[step, :count] = token
            token_1, token_2 = own[step], token_1
        if (np.abs(out) >= LARGEST).any():
            raise BadStream("a number is too large")
    if at != len(words) or (state != LOWEST).any():
        raise BadStream("it does not end where its table does")
    return lanes.taken_up(laid)


def _refilled(x: Array, words: Array, at: int) -> tuple[Array, int]:
    """A word for each lane whose state is below LOWEST."""
    low = (x < LOWEST).nonzero()[0]
    if low.size == 0:
        return x, at
    end = at + low.size
    if end > len(words):
        raise BadStream("it is cut short")
    x[low] = (x[low] << WORD) | words[at:end]
    return x, end


class _Column(NamedTuple):
    """A column's model. A slot is a context's number, times 2^PRECISION, and a state's low bits."""

    signed: bool
    weights: list[int]
    shares: list[int]
    contexts: int
    first_slot: Array
    """of the context, by activity"""
    tokens: Array
    """by slot"""
    frequencies: Array
    """of the slot's token"""
    offsets: Array
    """distance of the slot from its token's first one"""


def _read_model(model: Array, columns: int) -> Iterator[_Column]:
    """The columns of a model, one after the other; BadStream if it is none."""
    numbers, at = model.astype(np.int64), 0

    def take(count: int) -> Array:
        nonlocal at
        at += count
        if count < 0 or at > len(numbers):
            raise BadStream("its model is cut short")
        return numbers[at - count : at]

    for _ in range(columns):
        signed = bool(take(1)[0])
        weights, shares = take(1 + PREDICTORS).tolist(), take(ACTIVITY).tolist()
        count = int(take(1)[0])
        possible = count < MOST_CONTEXTS and max(map(abs, weights)) <= LARGEST_WEIGHT
        thresholds = take(count)
        possible &= (np.diff(thresholds) > 0).all() and 0 <= min(shares) and max(shares) <= LARGEST_SHARE
        table = np.zeros((min(count, MOST_CONTEXTS) + 1, TOKENS), dtype=np.int64)
        for frequencies in table:
            first, used = take(2).tolist()
            possible &= 0 <= first and 0 < used and first + used <= TOKENS
            if possible:
                frequencies[first : first + used] = take(used)
        if not possible or (table < 0).any() or (table.sum(axis=1) != 1 << PRECISION).any():
            raise BadStream("its model is none")
        starts = np.cumsum(table, axis=1) - table
        tokens = np.repeat(np.tile(np.arange(TOKENS), count + 1), table.ravel())
        slots = np.arange(len(tokens)) & ((1 << PRECISION) - 1)
        contexts = np.searchsorted(thresholds, np.arange(MOST_ACTIVITY + 1), side="right") << PRECISION
        offsets = slots - np.repeat(starts.ravel(), table.ravel())
        frequencies = np.repeat(table.ravel(), table.ravel())
        yield _Column(signed, weights, shares, count + 1, contexts, tokens, frequencies, offsets)
    if at != len(numbers):
        raise BadStream("its model does not end where its table does")
