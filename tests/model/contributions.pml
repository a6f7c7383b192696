/* Models the log of a shared head: contributions of sessions, markers that say which are in, replicas that fold the log,
 * and a Redis that loses markers or its last writes (docs/guides/fleet.md).
 *
 * Each contribution may be appended by any replica and repeatedly, as by the one that takes a session over.
 *
 * Checked, by assertions: no contribution is in the log twice, and none that was acknowledged is lost while a replica lives
 * that has taken it.
 *
 * Each of these is the old protocol, so that the check must fail:
 * -DMARKER_ONLY  only the marker tells whether the log has a contribution
 * -DNO_UNREAD    entries that the replica has not read are not searched
 *
 * run_model.py runs SPIN on this file. */

#define REPLICAS 2
#define CONTRIBUTIONS 3
#define MOST_LOSSES 1
#define MOST_APPENDS 6

/* Bits of contributions. The order in the log does not matter here, only how much of it a replica has read. */
byte entry[MOST_APPENDS];    /* contribution of each entry, from 1 */
byte length = 0;             /* of the log */
byte markers = 0;            /* bits */
byte old_length = 0;
byte old_markers = 0;
byte losses = 0;
byte read[REPLICAS];         /* entries that each replica has folded: HeadReplica::position() */
byte known[REPLICAS];        /* bits: HeadReplica::Find() */
byte acknowledged = 0;       /* bits */
byte i = 0;
byte count = 0;
bool found = false;

#define BIT(c) (1 << (c))

/* HeadLogStore::FoldTail() */
inline fold(r) {
  do
  :: read[r] < length -> known[r] = known[r] | BIT(entry[read[r]]); read[r]++
  :: else -> break
  od
}

inline check() {
  count = 0; i = 0; found = false;
  do
  :: i < length ->
    if
    :: (count & BIT(entry[i])) -> found = true
    :: else -> count = count | BIT(entry[i])
    fi;
    i++
  :: else -> break
  od;
  assert(!found);
  i = 0; count = 0; found = false
}

/* HeadLogStore::Reload(), Rewrite(), RestoreHeadMarkers(): the log is shorter than what this replica has folded. Its
 * entries are a prefix of them, so the heads of the replica stand for the log. */
inline rewrite(r) {
  length = read[r];
#ifndef MARKER_ONLY
  markers = markers | known[r]
#endif
}

proctype Replica(byte r) {
  byte c = 0;
  do
  /* VersionLog::Append(), HeadLogStore::AppendAndRead(), kAppend */
  :: atomic {
       length < MOST_APPENDS ->
       if
       :: c = 0
       :: c = 1
       :: c = 2
       fi;
       if
       :: read[r] > length -> rewrite(r)  /* kAppend finds that its position is not in the log (kStale) */
       :: else
       fi;
       found = (markers & BIT(c)) != 0;
#ifndef MARKER_ONLY
       found = found || (known[r] & BIT(c)) != 0;
#ifndef NO_UNREAD
       i = read[r];
       do
       :: i < length -> found = found || (entry[i] == c); i++
       :: else -> break
       od;
       i = 0;
#endif
#endif
       if
       :: found
       :: else -> entry[length] = c; length++; markers = markers | BIT(c)
       fi;
       found = false;
       fold(r);
       acknowledged = acknowledged | BIT(c);
       check();
       c = 0
     }
  :: atomic { read[r] < length -> fold(r) }
  od
}

active proctype Redis() {
  do
  :: atomic { losses < MOST_LOSSES -> old_length = length; old_markers = markers }
  /* It comes back with an older file. A replica that has folded more writes it again before it appends. */
  :: atomic {
       losses < MOST_LOSSES && (read[0] >= length || read[1] >= length) ->
       losses++; length = old_length; markers = old_markers;
       if
       :: read[0] >= read[1] -> rewrite(0)
       :: else -> rewrite(1)
       fi
     }
  /* It removes markers. */
  :: atomic { losses < MOST_LOSSES -> losses++; markers = 0 }
  od
}

init { atomic { run Replica(0); run Replica(1) } }
