/* Models what Redis holds of one session: a hash and a list as two keys, each command by itself, and what happens when
 * Redis refuses memory, loses its last writes, removes a key, or stops in the middle of a script because another node has
 * got the key of its next command (docs/guides/fleet.md). Durability SYNC.
 *
 * One replica owns the session and decides. Another one may claim it at any time, which ends the first one's ownership.
 * The client goes on at either, and sends its last requests again where a replica expects an older decision.
 *
 * Checked, by assertions:
 * - a journal that a replica claims is one that it can restore (no DATA_LOSS);
 * - while the owner lives and the store has not lost anything, what was acknowledged is in the store;
 * - nothing is acknowledged while the store has lost a part of the session;
 * - an acknowledged decision that the store has lost is one that the client still has.
 *
 * Each of these is the old protocol, so that the check must fail:
 * -DTRIM_ALONE    a snapshot is RPUSHX, LTRIM and PEXPIRE, of which Redis may refuse the first alone
 * -DBLIND_APPEND  an owner does not compare its journal, and readers refuse a gap
 * -DNO_HASH       an append does not look at the hash
 * -DLENGTH_ONLY   an append looks at the length of the list, and not at its base
 * -DFORGETFUL     the client keeps only the requests that the store does not have
 * -DDEL_FIRST     a snapshot removes the list before it writes the new one
 * -DRENAME_FIRST  a claim renames the list before it writes the hash
 *
 * run_model.py runs SPIN on this file. Behind each transition stands the function that implements it. */

#define DECISIONS 6
#define ENTRIES 2       /* in a list, beside the snapshot; then the next decision writes a snapshot */
#define MOST_LOSSES 1
#define MOST_REFUSALS 1
#define MOST_EVICTIONS 1
#define MOST_STOPS 1
#define NONE 99

/* The list: a snapshot of the first `snapshot` decisions, and entries. */
typedef List {
  bool exists = true;
  byte snapshot;
  byte length;           /* entries */
  byte entry[4];         /* number of the decision after each entry */
  byte last = NONE       /* a snapshot behind the entries, whose script has stopped; or NONE */
};

List list;
bool hash = true;
byte base = 0;           /* HGET base: decisions in the snapshot that the owner has written */
byte epoch = 1;

/* What an append-only file of some time ago has. */
List old_list;
bool old_hash = true;
byte old_base = 0;
byte old_epoch = 1;

byte losses = 0;
byte refusals = 0;
byte evictions = 0;
byte stops = 0;
bool is_full = false;
bool reconnected = false;  /* since the owner has compared its journal */
bool lost = false;         /* the store has lost something that the owner has not written again */

byte acknowledged = 0;     /* decisions whose answers the client has */
byte kept_from = 0;        /* the first request that the client still has */
byte decided = 0;          /* of the owner's copy */
byte my_base = 0;          /* of the owner: SessionJournal::base_ */
byte my_length = 0;        /* of the owner: SessionJournal::records_ */
bool owns = true;
byte restored = 0;

inline copy_list(to, from) {
  to.exists = from.exists; to.snapshot = from.snapshot; to.length = from.length; to.last = from.last;
  to.entry[0] = from.entry[0]; to.entry[1] = from.entry[1]; to.entry[2] = from.entry[2]; to.entry[3] = from.entry[3]
}

/* ParseJournal(), RestoreSession(): what a reader makes of the list. */
inline read_list() {
  restored = list.snapshot;
  i = 0;
  do
  :: i < list.length ->
    if
    :: list.entry[i] <= restored
    :: list.entry[i] == restored + 1 -> restored++
    :: list.entry[i] > restored + 1 ->
#ifdef BLIND_APPEND
      assert(false);  /* DATA_LOSS */
#endif
      break
    fi;
    i++
  :: else -> break
  od;
  i = 0;
  restored = (list.last != NONE -> list.last : restored)
}

/* What a script that has stopped leaves, unless the store had lost something before. */
inline check_stopped() {
  stops++; written = false;
  if
  :: !lost -> check_acknowledged()
  :: else
  fi
}

/* RedisBackend::AppendSnapshot(): kPut, RPUSH, HSET and LTRIM. It may stop before each of them. */
inline put_snapshot() {
  if
  :: is_full -> written = false
#ifdef DEL_FIRST
  :: !is_full && stops < MOST_STOPS ->
    hash = true; base = decided; list.exists = false; list.length = 0; check_stopped()
#else
  :: !is_full && stops < MOST_STOPS -> list.exists = true; list.last = decided; check_stopped()
  :: !is_full && stops < MOST_STOPS ->
    list.exists = true; list.last = decided; hash = true; base = decided; check_stopped()
#endif
  :: !is_full ->
    hash = true; base = decided; list.exists = true; list.snapshot = decided; list.length = 0;
    list.entry[0] = 0; list.entry[1] = 0; list.entry[2] = 0; list.entry[3] = 0; list.last = NONE;
    my_base = decided; my_length = 0; lost = false; written = true
  fi
}

/* The old way: each command by itself. */
inline put_snapshot_in_parts() {
  if
  :: is_full -> written = false  /* RPUSHX is refused, LTRIM runs: the last entry alone stays */
    if
    :: list.length > 0 -> list.snapshot = 99; list.length = 1
    :: else
    fi
  :: else -> put_snapshot()
  fi
}

/* RedisBackend::Append(), ReadReplies(): HGET base and RPUSHX. */
inline append_entry() {
  if
  :: is_full || !list.exists || list.last != NONE -> written = false  /* the snapshot is sent again first */
  :: else ->
    if
    :: list.length < 4 -> list.entry[list.length] = decided; list.length++
    :: else
    fi;
#if defined(BLIND_APPEND)
    written = (list.length == my_length + 1);
#elif defined(NO_HASH)
    written = (base == my_base && list.length == my_length + 1);
#elif defined(LENGTH_ONLY)
    written = (hash && list.length == my_length + 1);
#else
    written = (hash && base == my_base && list.length == my_length + 1);
#endif
    my_length = (written -> my_length + 1 : my_length)
  fi
}

/* JournalStore::CheckJournals(), RedisBackend::CheckAll(): after a reconnect, before anything else. */
inline check_journal() {
#ifndef BLIND_APPEND
#ifndef LENGTH_ONLY
  if
  :: !hash || !list.exists || base != my_base || list.length != my_length -> put_snapshot()  /* WriteAgain() */
  :: else -> written = true
  fi;
#else
  if
  :: !hash || !list.exists || list.length != my_length -> put_snapshot()
  :: else -> written = true
  fi;
#endif
  if
  :: written -> reconnected = false
  :: else
  fi
#else
  reconnected = false
#endif
}

inline check_acknowledged() {
  read_list();
  assert(list.exists && hash && restored >= acknowledged)
}

active proctype Owner() {
  bool written = false;
  byte i = 0;
  do
  :: atomic { owns && reconnected -> check_journal(); written = false }
  /* AgentSession::Decide(), SessionJournal::OnDecision(). The answer waits (WhenDurable()). */
  :: atomic {
       owns && !reconnected && decided < DECISIONS ->
       decided++;
       if
       :: my_length < ENTRIES -> append_entry()
#ifdef TRIM_ALONE
       :: else -> put_snapshot_in_parts()
#else
       :: else -> put_snapshot()
#endif
       fi;
       if
       :: written ->
         acknowledged = decided;
#ifdef FORGETFUL
         kept_from = decided;
#endif
         check_acknowledged()
       :: else ->
         /* SessionJournal::LoseRecords(), JournalStore::WriteAgain(). */
#ifdef BLIND_APPEND
         decided--
#else
#ifdef TRIM_ALONE
         decided--
#else
         if
         :: is_full -> decided--  /* the record stays in the queue */
         :: else ->
           put_snapshot();
           if
           :: written ->
             acknowledged = decided;
#ifdef FORGETFUL
             kept_from = decided;
#endif
             check_acknowledged()
           :: else -> decided--
           fi
         fi
#endif
#endif
       fi;
       written = false
     }
  od
}

/* SessionRecovery::Restore(): another replica claims what is there. The client sends again what it misses. */
active proctype Claimant() {
  byte i = 0;
  bool written = false;
  do
  /* kClaim: RPUSH of a copy and HSET, or once RENAME and HSET. It stops after the first one. */
  :: atomic {
       owns && hash && list.exists && stops < MOST_STOPS ->
#ifdef RENAME_FIRST
       list.exists = false; list.length = 0;  /* no hash names it any more */
#endif
       check_stopped()
     }
  :: atomic {
       owns && hash && list.exists ->
       owns = false;
       epoch++;
       assert(list.snapshot != 99);  /* an entry without a snapshot is DATA_LOSS */
       read_list();
       assert(restored >= acknowledged || kept_from <= restored);  /* Unacknowledged, SessionCursor.missing() */
       break
     }
  od
}

active proctype Redis() {
  do
  /* The append-only file of now. */
  :: atomic { losses < MOST_LOSSES && owns -> copy_list(old_list, list); old_hash = hash; old_base = base }
  /* It comes back with an older one, or a copy takes its place. */
  :: atomic {
       losses < MOST_LOSSES && owns && old_list.exists ->
       losses++; copy_list(list, old_list); hash = old_hash; base = old_base; reconnected = true; lost = true
     }
  :: atomic { refusals < MOST_REFUSALS && owns && !is_full -> refusals++; is_full = true }
  :: atomic { is_full -> is_full = false }
  /* It evicts one of the keys. */
  :: atomic { evictions < MOST_EVICTIONS && owns -> evictions++; hash = false; lost = true }
  :: atomic { evictions < MOST_EVICTIONS && owns -> evictions++; list.exists = false; list.length = 0; list.last = NONE; lost = true }
  od
}
