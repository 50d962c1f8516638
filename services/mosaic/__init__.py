"""Many scenes on one map: levelled, cut along seams where they agree, and the steps there measured."""
