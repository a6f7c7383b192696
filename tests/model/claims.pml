/* Models how replicas claim a session and append its decisions (docs/fleet.md), with durability SYNC.
 *
 * One client plays a session on several replicas. It may send a request to any of them, at any time and repeatedly,
 * as a client does that waits no longer. Replicas are slow at any point, which is how a stopped process looks from
 * outside, and are killed. Messages to the store may be delivered long after they were sent, also those of a replica
 * that was killed since. The store is a primary with one copy, which takes its place at a failover.
 *
 * Checked, by assertions:
 * - at most one replica's answer is accepted for each decision: two answers that reach the client are the same one;
 * - no decision whose answer reached the client is missing in the store, or another one there.
 *
 * Each of these breaks the protocol, so that the check must fail:
 * -DNO_FENCE  the store takes appends of former owners
 * -DNO_WAIT   the store acknowledges before its copy has the write (--store_replicas=0)
 * -DNO_SYNC   a replica answers before the store has acknowledged
 *
 * run_model.py runs SPIN on this file. */

#define REPLICAS 2
#define DECISIONS 2

/* Bounds, which keep the number of states finite. */
#define MOST_CLAIMS 3
#define MOST_KILLS 1
#define MOST_FAILOVERS 1

#define NOBODY 0

mtype = { CLAIM, APPEND, DONE, REFUSED, BROKEN };

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

byte claims = 0;
byte kills = 0;
byte failovers = 0;

/* Of the client. */
byte accepted[DECISIONS];  /* 0: none */
byte next_decision = 0;

chan requests[REPLICAS] = [0] of { byte };                           /* decision */
chan answers = [0] of { byte, byte };                                /* decision, made_by */
chan to_store[REPLICAS] = [1] of { mtype, byte, byte, byte, byte };  /* kind, life, epoch, decision, made_by */
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
#ifdef NO_WAIT
  to_replica[r]!outcome, life
#else
  owed[r] = true;
  owed_outcome[r] = outcome;
  owed_life[r] = life
#endif
}

/* Runs the oldest message of replica r. */
inline serve(r) {
  to_store[r]?kind, life, epoch, decision, made_by;
  if
  :: kind == CLAIM ->
    primary.epoch++;
    assign(claimed[r], primary);
    reply(r, DONE, life)
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
      /* A decision that is there already was sent again. */
      if
      :: decision == primary.length ->
        primary.made_by[decision] = made_by;
        primary.length++
      :: else
      fi;
      reply(r, DONE, life)
    :: epoch == primary.epoch && decision > primary.length -> reply(r, REFUSED, life)
    fi
  fi;
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
  assign(copy, primary);
  do
  :: atomic { nempty(to_store[0]) && !owed[0] && nfull(to_replica[0]) -> serve(0) }
  :: atomic { nempty(to_store[1]) && !owed[1] && nfull(to_replica[1]) -> serve(1) }
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

/* Ends the process at any point. What it has sent is still on its way. */
inline may_be_killed() {
  if
  :: true
  :: atomic {
       kills < MOST_KILLS ->
       kills++;
       life++;
       held.epoch = 0; held.length = 0; held.made_by[0] = 0; held.made_by[1] = 0;
       outcome = DONE; decision = 0; life_of_outcome = 0;
       goto idle
     }
  fi
}

proctype Replica(byte r) {
  Journal held;  /* its copy of the session; epoch 0: it does not have the session */
  byte life = 0;
  byte decision = 0;
  byte life_of_outcome = 0;
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
    :: decision < held.length  /* answered before: the stored answer, once the store has it */
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
       :: outcome == BROKEN  /* the record stays in the queue and is sent again */
       :: outcome == REFUSED ->
         atomic { held.epoch = 0; held.length = 0; held.made_by[0] = 0; held.made_by[1] = 0 };
         goto idle
       fi
    od;
    may_be_killed();
#endif
    answers!decision, held.made_by[decision]
  od
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
