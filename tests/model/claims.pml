/* Models how replicas claim a session and append its decisions (docs/guides/fleet.md), with durability SYNC.
 *
 * One client plays a session on several replicas. It may send a request to any of them, at any time and repeatedly,
 * as a client does that waits no longer. Replicas are slow at any point, which is how a stopped process looks from
 * outside, and are killed. Messages to the store may be delivered long after they were sent, also those of a replica
 * that was killed since, and those of a connection that has ended, when the replica has sent others on a new one. The
 * store is a primary with one copy, which takes its place at a failover.
 *
 * Checked, by assertions:
 * - at most one replica's answer is accepted for each decision: two answers that reach the client are the same one;
 * - no decision whose answer reached the client is missing in the store, or another one there.
 *
 * Each of these breaks the protocol, so that the check must fail:
 * -DNO_FENCE  the store takes appends of former owners
 * -DNO_WAIT   the store acknowledges before its copy has the write (--store_replicas=0)
 * -DNO_SYNC   a replica answers before the store has acknowledged
 * -DNO_MOVE   a replica sends a record again without moving the journal to a new epoch first
 *
 * run_model.py runs SPIN on this file. */

#define REPLICAS 2
#define DECISIONS 2

/* Bounds, which keep the number of states finite. */
#define MOST_CLAIMS 3
#define MOST_KILLS 1
#define MOST_FAILOVERS 1

#define NOBODY 0

mtype = { CLAIM, APPEND, MOVE, DONE, REFUSED, BROKEN };

/* What a decision was: 1 + the number of the process that made it. A killed replica goes on as another process. */
#define MADE_BY(replica, life) (1 + (replica) + REPLICAS * (life))

/* A journal: one entry for each decision. */
typedef Journal {
  byte epoch;
  byte length;
  byte made_by[DECISIONS]
};

Journal primary;
Journal copy;
Journal claimed[REPLICAS];   /* what the last claim of a replica returned */

byte last_epoch = 0;  /* no epoch is given twice: replicas draw them */
byte claims = 0;
byte kills = 0;
byte failovers = 0;
bool overtaken = false;

/* Of the client. */
byte accepted[DECISIONS];  /* 0: none */
byte next_decision = 0;

chan requests[REPLICAS] = [0] of { byte };                           /* decision */
chan answers = [0] of { byte, byte };                                /* decision, made_by */
/* kind, life, epoch, decision or new epoch, made_by */
chan to_store[REPLICAS] = [1] of { mtype, byte, byte, byte, byte };
chan late = [1] of { mtype, byte, byte, byte, byte };  /* of a connection that has ended */
chan to_replica[REPLICAS] = [1] of { mtype, byte };                  /* outcome, life */

/* A message whose outcome waits for the copy. */
mtype owed_outcome[REPLICAS];
byte owed_life[REPLICAS];
bool owed[REPLICAS];

inline assign(to, from) {
  to.epoch = from.epoch;
  to.length = from.length;
  to.made_by[0] = from.made_by[0];
  to.made_by[1] = from.made_by[1]
}

inline check_nothing_lost() {
  assert(accepted[0] == NOBODY || (primary.length > 0 && primary.made_by[0] == accepted[0]));
  assert(accepted[1] == NOBODY || (primary.length > 1 && primary.made_by[1] == accepted[1]))
}

inline reply(r, outcome, life) {
  if
  :: is_late
#ifdef NO_WAIT
  :: else -> to_replica[r]!outcome, life
#else
  :: else -> owed[r] = true; owed_outcome[r] = outcome; owed_life[r] = life
#endif
  fi
}

/* Runs a message of replica r. A record stands for a snapshot, which replaces what is there. */
inline execute(r) {
  if
  :: kind == CLAIM ->
    last_epoch++;
    primary.epoch = last_epoch;
    if
    :: is_late
    :: else -> assign(claimed[r], primary)
    fi;
    reply(r, DONE, life)
  :: kind == MOVE ->
    if
    :: epoch == primary.epoch -> primary.epoch = decision; reply(r, DONE, life)
    :: decision == primary.epoch -> reply(r, DONE, life)  /* it was moved before */
    :: else -> reply(r, REFUSED, life)
    fi
  :: kind == APPEND ->
    if
#ifndef NO_FENCE
    :: epoch != primary.epoch -> reply(r, REFUSED, life)
#endif
#ifdef NO_FENCE
    :: decision <= primary.length ->
#else
    :: epoch == primary.epoch && decision <= primary.length ->
#endif
      primary.length = decision + 1;
      primary.made_by[decision] = made_by;
      if
      :: decision == 0 -> primary.made_by[1] = NOBODY
      :: else
      fi;
      reply(r, DONE, life)
    :: epoch == primary.epoch && decision > primary.length -> reply(r, REFUSED, life)
    fi
  fi;
  kind = CLAIM; life = 0; epoch = 0; decision = 0; made_by = 0; is_late = false
}

/* Runs the oldest message of replica r. */
inline serve(r) {
  to_store[r]?kind, life, epoch, decision, made_by;
  execute(r)
}

inline serve_late() {
  late?kind, life, epoch, decision, made_by;
  is_late = true;
  execute(0)
}

/* The connection of replica 0 ends while a record is on its way, which the store runs later. Once is enough, and one
 * replica: they are alike. */
inline overtake() {
  overtaken = true;
  to_store[0]?kind, life, epoch, decision, made_by;
  late!kind, life, epoch, decision, made_by;
  to_replica[0]!BROKEN, life;
  kind = CLAIM; life = 0; epoch = 0; decision = 0; made_by = 0
}

inline pay(r) {
  if
  :: owed[r] -> to_replica[r]!owed_outcome[r], owed_life[r]; owed[r] = false
  :: else
  fi
}

/* The connection of a replica breaks: it learns no outcome. */
inline break_connection(r) {
  if
  :: owed[r] -> to_replica[r]!BROKEN, owed_life[r]; owed[r] = false
  :: else
  fi
}

active proctype Store() {
  mtype kind = CLAIM;
  byte life = 0;
  byte epoch = 0;
  byte decision = 0;
  byte made_by = 0;
  bool is_late = false;
  assign(copy, primary);
  do
  :: atomic { nempty(to_store[0]) && !owed[0] && nfull(to_replica[0]) -> serve(0) }
  :: atomic { nempty(to_store[1]) && !owed[1] && nfull(to_replica[1]) -> serve(1) }
  :: atomic {
       !overtaken && to_store[0]?[APPEND, life, epoch, decision, made_by] && !owed[0] && nfull(to_replica[0]) -> overtake()
     }
  :: atomic { nempty(late) -> serve_late(); check_nothing_lost() }
  /* The copy takes over what the primary has. */
  :: atomic {
       (copy.epoch != primary.epoch || copy.length != primary.length || owed[0] || owed[1]) &&
       nfull(to_replica[0]) && nfull(to_replica[1]) ->
       assign(copy, primary);
       pay(0);
       pay(1)
     }
  :: atomic {
       failovers < MOST_FAILOVERS && nfull(to_replica[0]) && nfull(to_replica[1]) ->
       failovers++;
       assign(primary, copy);
       check_nothing_lost();
       break_connection(0);
       break_connection(1)
     }
  od
}

/* Waits for the outcome of the last message. Outcomes of a former life are not of interest. */
inline await_outcome() {
  do
  :: to_replica[r]?outcome, life_of_outcome ->
    if
    :: life_of_outcome == life -> life_of_outcome = 0; break
    :: else
    fi
  od
}

inline forget() {
  held.epoch = 0; held.length = 0; held.made_by[0] = 0; held.made_by[1] = 0;
  outcome = DONE; decision = 0; life_of_outcome = 0; new_epoch = 0
}

/* Ends the process at any point. What it has sent is still on its way. */
inline may_be_killed() {
  if
  :: true
  :: atomic {
       kills < MOST_KILLS ->
       kills++;
       life++;
       forget();
       goto idle
     }
  fi
}

proctype Replica(byte r) {
  Journal held;  /* its copy of the session; epoch 0: it does not have the session */
  byte life = 0;
  byte decision = 0;
  byte life_of_outcome = 0;
  byte new_epoch = 0;
  mtype outcome = DONE;

idle:
  do
  :: requests[r]?decision ->
    if
    :: held.epoch == 0 && claims < MOST_CLAIMS ->
      atomic { claims++; to_store[r]!CLAIM, life, 0, 0, 0 };
      may_be_killed();
      await_outcome();
      if
      :: outcome == DONE -> atomic { assign(held, claimed[r]) }
      :: else -> goto idle  /* UNAVAILABLE */
      fi
    :: held.epoch == 0 && claims == MOST_CLAIMS -> goto idle
    :: held.epoch > 0
    fi;
    may_be_killed();
    if
    :: decision > held.length -> goto idle  /* OUT_OF_ORDER */
    :: decision < held.length -> goto answer  /* the store has it */
    :: decision == held.length ->
      atomic { held.made_by[decision] = MADE_BY(r, life); held.length++ }
    fi;
#ifndef NO_SYNC
    do
    :: to_store[r]!APPEND, life, held.epoch, decision, held.made_by[decision];
       may_be_killed();
       await_outcome();
       if
       :: outcome == DONE -> break
       :: outcome == BROKEN  /* the record stays in the queue and is sent again, after the move */
       :: outcome == REFUSED -> goto lost
       fi;
#ifndef NO_MOVE
       atomic { last_epoch++; new_epoch = last_epoch };
       do
       :: to_store[r]!MOVE, life, held.epoch, new_epoch, NOBODY;
          may_be_killed();
          await_outcome();
          if
          :: outcome == DONE -> atomic { held.epoch = new_epoch; new_epoch = 0 }; break
          :: outcome == BROKEN
          :: outcome == REFUSED -> goto lost
          fi
       od
#endif
    od;
    may_be_killed();
#endif
answer:
    answers!decision, held.made_by[decision]
  od;

lost:
  atomic { forget(); goto idle }
}

active proctype Client() {
  byte decision = 0;
  byte made_by = 0;
  atomic { run Replica(0); run Replica(1) };
  do
  :: next_decision < DECISIONS -> requests[0]!next_decision
  :: next_decision < DECISIONS -> requests[1]!next_decision
  :: atomic {
       answers?decision, made_by ->
       if
       :: accepted[decision] == NOBODY ->
         assert(decision == next_decision);
         accepted[decision] = made_by;
         next_decision++
       :: else -> assert(accepted[decision] == made_by)
       fi;
       decision = 0; made_by = 0
     }
  od
}
