"""Mosaics: many scenes on one map, levelled, cut along seams, with measured steps at the seams."""
