/* Models the log of a shared head: contributions of sessions, markers that say which are in, replicas that fold the log,
 * and a Redis that loses markers, its last writes, or the log behind its snapshot (docs/guides/fleet.md).
 *
 * Each contribution may be appended by any replica and repeatedly, as by the one that takes a session over. A replica
 * notices whenever it looks that the log does not have its position any more. A log that was written again, or whose Redis
 * has started again, takes no entries until every replica has looked, which stands for the seconds of kSettling.
 *
 * Checked, by assertions: no contribution is in the log twice, none that was acknowledged is lost while a replica lives
 * that has taken it, and a script that stops half-way removes none.
 *
 * Each of these is the old protocol, so that the check must fail:
 * -DMARKER_ONLY     only the marker tells whether the log has a contribution
 * -DNO_UNREAD       entries that the replica has not read are not searched
 * -DFIRST_REWRITES  a log that was written again takes entries at once
 * -DSAME_RUN        a log whose Redis has started again takes entries at once
 * -DFORGETFUL       a replica does not know positions of some time ago, and takes the snapshot's heads
 * -DDEL_FIRST       the script that writes a log again, and may stop, removes the old one before it writes the snapshot
 *
 * run_model.py runs SPIN on this file. */

#define REPLICAS 2
#define CONTRIBUTIONS 3
#define MOST_LOSSES 1
#define MOST_STOPS 1
#define MOST_APPENDS 5

byte entry[MOST_APPENDS];    /* contribution of each entry, from 0 */
byte length = 0;             /* of the log; without a log, of what its snapshot stands for */
bool exists = true;          /* the log, in which the positions of replicas are */
byte snapshot = 0;           /* entries that the snapshot stands for */
byte markers = 0;            /* bits of contributions */
byte old_length = 0;
byte old_markers = 0;
byte old_snapshot = 0;
byte losses = 0;
byte stops = 0;
bool stopped = false;
byte mine[10];               /* entries that each replica has folded, REPLICAS * MOST_APPENDS */
byte read[REPLICAS];         /* how many: HeadFold::position() */
bool settling = false;
byte looked = 0;             /* replicas, since the log was written again */
byte acknowledged = 0;       /* bits */
byte i = 0;
byte count = 0;
bool found = false;
bool same = true;

#define BIT(c) (1 << (c))
#define MINE(r, n) mine[(r) * MOST_APPENDS + (n)]

/* Sets `same` if the log and a replica have equal entries as far as both go: HeadFold::HasPassed(). */
inline compare(r) {
  same = true; i = 0;
  do
  :: i < length && i < read[r] -> same = same && (entry[i] == MINE(r, i)); i++
  :: else -> break
  od;
  i = 0
}

/* VersionLog::FoldTail() */
inline fold(r) {
  do
  :: read[r] < length -> MINE(r, read[r]) = entry[read[r]]; read[r]++
  :: else -> break
  od
}

/* VersionLog::Rewrite(), RedisHeadLog::Replace(). kReplace may stop before it puts the new log in its place: the
 * snapshot stands for a log that is gone; one that is there stays. */
inline rewrite(r) {
  count = length;
#ifdef DEL_FIRST
  if
  :: stops < MOST_STOPS -> stops++; stopped = true; exists = false; length = snapshot
  :: rewrite_whole(r, true)
  fi;
#else
  if
  :: stops < MOST_STOPS && exists -> stops++; stopped = true; settling = true; looked = 0
  :: stops < MOST_STOPS && !exists -> stops++; stopped = true; rewrite_whole(r, false); snapshot = length
  :: rewrite_whole(r, true)
  fi;
#endif
  assert(!stopped || length >= count);  /* what is stored lives on if the replica dies */
  count = 0
}

inline rewrite_whole(r, is_there) {
  i = 0;
  do
  :: i < read[r] ->
    entry[i] = MINE(r, i);
#ifndef MARKER_ONLY
    markers = markers | BIT(entry[i]);
#endif
    i++
  :: else -> break
  od;
  i = 0;
  length = read[r]; exists = is_there;
  settling = true; looked = 0
}

/* Sets `same` if the log has the position of a replica: kAppend, FoldTail(). */
inline find_position(r) {
  compare(r);
  same = read[r] == 0 || (exists && same && read[r] <= length)
}

/* VersionLog::FoldTail(), Reload() */
inline look(r) {
  find_position(r);
  if
  :: same -> fold(r)
  :: else ->
    compare(r);
#ifdef FORGETFUL
    same = same && (exists || read[r] == length);
#endif
    if
    :: same && length < read[r] -> rewrite(r)
    :: else ->
      read[r] = 0; fold(r);
      if
      :: !exists -> rewrite(r)
      :: else
      fi
    fi
  fi;
  looked = (stopped -> looked : looked | BIT(r));
  stopped = false;
  settling = settling && (looked != 3);
  same = true
}

/* Sets `found` if the log, as far as the replica and kAppend can tell, has contribution c. */
inline search(r) {
  found = (markers & BIT(c)) != 0;
#ifndef MARKER_ONLY
  i = 0;
  do
  :: i < read[r] -> found = found || (MINE(r, i) == c); i++
  :: else -> break
  od;
#ifndef NO_UNREAD
  do
  :: i < length -> found = found || (entry[i] == c); i++
  :: else -> break
  od;
#endif
  i = 0
#endif
}

inline check() {
  count = 0; i = 0; found = false;
  do
  :: i < length -> found = found || ((count & BIT(entry[i])) != 0); count = count | BIT(entry[i]); i++
  :: else -> break
  od;
  assert(!found);  /* none is there twice */
  i = 0;
  do
  :: i < read[0] -> count = count | BIT(MINE(0, i)); i++
  :: else -> break
  od;
  i = 0;
  do
  :: i < read[1] -> count = count | BIT(MINE(1, i)); i++
  :: else -> break
  od;
  assert((acknowledged & count) == acknowledged);  /* none is lost */
  i = 0; count = 0
}

proctype Replica(byte r) {
  byte c = 0;
  do
  /* VersionLog::Append(), AppendAndRead(), kAppend: nothing if the log does not have its position. */
  :: atomic {
       length < MOST_APPENDS ->
       if
       :: c = 0
       :: c = 1
       :: c = 2
       fi;
       find_position(r);
#ifndef FIRST_REWRITES
       same = same && !settling;
#endif
       if
       :: same ->
         search(r);
         if
         :: found
         :: else -> entry[length] = c; length++; markers = markers | BIT(c)
         fi;
         fold(r);
         acknowledged = acknowledged | BIT(c)
       :: else
       fi;
       found = false; same = true;
       check();
       c = 0
     }
  :: atomic { read[r] != length || !exists || settling -> look(r); check() }
  /* VersionLog::StoreSnapshotIfDue() */
  :: atomic { exists && !settling && read[r] == length && snapshot < length -> snapshot = length }
  od
}

active proctype Redis() {
  do
  :: atomic { losses < MOST_LOSSES -> old_length = length; old_markers = markers; old_snapshot = snapshot }
  /* It comes back with an older file, or with none after every replica has read some of the log. */
  :: atomic {
       losses < MOST_LOSSES && (old_length > 0 || (read[0] > 0 && read[1] > 0)) ->
       losses++; length = old_length; markers = old_markers; snapshot = old_snapshot;
#ifndef SAME_RUN
       settling = (old_length > 0); looked = 0
#endif
     }
  /* It removes markers. */
  :: atomic { losses < MOST_LOSSES -> losses++; markers = 0 }
  /* It removes the log and not the snapshot, or both, after every replica has read some of it. */
  :: atomic { losses < MOST_LOSSES && read[0] > 0 && read[1] > 0 -> losses++; exists = false; length = snapshot }
  od
}

init { atomic { run Replica(0); run Replica(1) } }
