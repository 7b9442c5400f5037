/* A libnvidia-ml.so.1 for tests: what pynvml calls, answered from the control file $NVML_STUB, read again at every call.
 *
 *   gpu UUID TOTAL RESERVED USED [mig]                         one line a GPU, in the driver's order
 *   instance GPU PLACE ID UUID TOTAL RESERVED USED             a GPU instance with one compute instance, of a GPU in MIG mode
 *   sensors GPU PERCENT CELSIUS MILLIWATTS                     none without it
 *   late GPU BYTES UNTIL                                       BYTES more are used until UNTIL (CLOCK_MONOTONIC, seconds)
 *   process GPU compute|graphics PID BYTES|na [UNTIL [ID]]     listed until then (inf: for ever), on the GPU instance ID
 *   error CALL CODE [AFTER]                                    CALL: init count memory memory_v2 compute graphics mig
 *   hang CALL [AFTER]                                          does not return before the line is gone
 *
 * AFTER: so many calls of a process are answered before.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#define GPUS 8
#define PROCESSES 64
#define PLACES 7
#define NO_INSTANCE 0xFFFFFFFFu
#define NA 0xFFFFFFFFFFFFFFFFull
enum { SUCCESS = 0, INVALID_ARGUMENT = 2, NOT_SUPPORTED = 3, NO_PERMISSION = 4, INSUFFICIENT_SIZE = 7, NOT_FOUND = 6, VERSION_MISMATCH = 25, UNKNOWN = 999 };

typedef unsigned long long u64;
typedef struct { char uuid[96]; u64 total, reserved, used; int mig; unsigned id, sensors[3]; int told; } Gpu; /* or an instance */
typedef struct { int gpu, graphics; unsigned pid; u64 used; unsigned id; } Process;
typedef struct { Gpu gpus[GPUS], places[GPUS][PLACES]; int n_gpus; Process processes[PROCESSES]; int n_processes; int error, hangs; } World;

typedef struct { u64 total, free, used; } Memory;
typedef struct { unsigned gpu, memory; } Utilization;
typedef struct { unsigned version; u64 total, reserved, free, used; } MemoryV2;
typedef struct { unsigned pid; u64 used; unsigned instance, compute_instance; } ProcessInfo;

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + t.tv_nsec / 1e9;
}

/* How often this process has made a call, with this time. */
static int times(const char *call) {
    static struct { const char *call; int n; } made[16];
    int i = 0;
    while (i < 15 && made[i].call && strcmp(made[i].call, call)) i++;
    made[i].call = call;
    return ++made[i].n;
}

static void look(const char *call, int n, World *world) {
    const char *path = getenv("NVML_STUB");
    memset(world, 0, sizeof *world);
    FILE *file = path ? fopen(path, "r") : NULL;
    if (!file) { world->error = UNKNOWN; return; }
    char line[512], word[96], bytes[32];
    while (fgets(line, sizeof line, file)) {
        Gpu gpu = {0};
        Process process = {.id = NO_INSTANCE};
        u64 count;
        int index, place, code, after = 0;
        double until = 1e18;
        if (sscanf(line, "gpu %95s %llu %llu %llu", gpu.uuid, &gpu.total, &gpu.reserved, &gpu.used) == 4) {
            gpu.mig = strstr(line, " mig") != NULL;
            if (world->n_gpus < GPUS) world->gpus[world->n_gpus++] = gpu;
        } else if (sscanf(line, "instance %d %d %u %95s %llu %llu %llu", &index, &place, &gpu.id, gpu.uuid, &gpu.total,
                          &gpu.reserved, &gpu.used) == 7) {
            world->places[index][place] = gpu;
        } else if (sscanf(line, "sensors %d %u %u %u", &index, &gpu.sensors[0], &gpu.sensors[1], &gpu.sensors[2]) == 4) {
            memcpy(world->gpus[index].sensors, gpu.sensors, sizeof gpu.sensors);
            world->gpus[index].told = 1;
        } else if (sscanf(line, "late %d %llu %lf", &index, &count, &until) == 3) {
            if (until > now()) world->gpus[index].used += count;
        } else if (sscanf(line, "process %d %95s %u %31s %lf %u", &process.gpu, word, &process.pid, bytes, &until,
                          &process.id) >= 4) {
            process.graphics = strcmp(word, "graphics") == 0;
            process.used = strcmp(bytes, "na") == 0 ? NA : strtoull(bytes, NULL, 10);
            if (until > now() && world->n_processes < PROCESSES) world->processes[world->n_processes++] = process;
        } else if (sscanf(line, "error %95s %d %d", word, &code, &after) >= 2) {
            if (strcmp(word, call) == 0 && n > after) world->error = code;
        } else if (sscanf(line, "hang %95s %d", word, &after) >= 1) {
            if (strcmp(word, call) == 0 && n > after) world->hangs = 1;
        }
    }
    fclose(file);
}

/* The world as this call sees it; a nonzero result is the error to return. */
static int begin(const char *call, World *world) {
    int n = times(call);
    for (look(call, n, world); world->hangs; look(call, n, world)) usleep(10000);
    return world->error;
}

/* Handles: 1 + 8 * GPU for a GPU, one more for each place of an instance. */
static int index_of(void *handle) { return ((int)(long)handle - 1) / 8; }
static int place_of(void *handle) { return ((int)(long)handle - 1) % 8 - 1; }
static void *handle_of(int index, int place) { return (void *)(long)(8 * index + place + 2); }

static Gpu *gpu_of(void *handle, World *world) {
    int index = index_of(handle), place = place_of(handle);
    return place < 0 ? &world->gpus[index] : &world->places[index][place];
}

int nvmlInitWithFlags(unsigned flags) { World w; (void)flags; return begin("init", &w); }
int nvmlShutdown(void) { return SUCCESS; }

const char *nvmlErrorString(int code) {
    switch (code) {
        case 3: return "Not Supported";
        case 4: return "Insufficient Permissions";
        case 9: return "Driver Not Loaded";
        case 13: return "Function Not Found";
        case 15: return "GPU is lost";
        default: return "Unknown Error";
    }
}

int nvmlSystemGetDriverVersion(char *text, unsigned size) { snprintf(text, size, "000.00 stub"); return SUCCESS; }

int nvmlDeviceGetCount_v2(unsigned *count) {
    World w;
    int error = begin("count", &w);
    *count = w.n_gpus;
    return error;
}

int nvmlDeviceGetHandleByIndex_v2(unsigned index, void **handle) {
    World w;
    int error = begin("handle", &w);
    *handle = handle_of(index, -1);
    return error ? error : (int)index < w.n_gpus ? SUCCESS : INVALID_ARGUMENT;
}

int nvmlDeviceGetHandleByUUID(const char *uuid, void **handle) {
    World w;
    int error = begin("uuid", &w);
    for (int index = 0; index < w.n_gpus; index++)
        for (int place = -1; place < PLACES; place++)
            if (strcmp(gpu_of(*handle = handle_of(index, place), &w)->uuid, uuid) == 0) return error;
    return NOT_FOUND;
}

int nvmlDeviceGetUUID(void *handle, char *text, unsigned size) {
    World w;
    int error = begin("uuid", &w);
    snprintf(text, size, "%s", gpu_of(handle, &w)->uuid);
    return error;
}

int nvmlDeviceGetName(void *handle, char *text, unsigned size) {
    snprintf(text, size, place_of(handle) < 0 ? "NVIDIA Stub" : "NVIDIA Stub MIG 1g.4gb");
    return SUCCESS;
}

int nvmlDeviceGetMigMode(void *handle, unsigned *current, unsigned *pending) {
    World w;
    int error = begin("mig", &w);
    *current = *pending = w.gpus[index_of(handle)].mig;
    return error;
}

int nvmlDeviceGetMaxMigDeviceCount(void *handle, unsigned *count) { (void)handle; *count = PLACES; return SUCCESS; }

int nvmlDeviceGetMigDeviceHandleByIndex(void *handle, unsigned place, void **instance) {
    World w;
    int error = begin("mig", &w);
    *instance = handle_of(index_of(handle), place);
    return error ? error : gpu_of(*instance, &w)->total ? SUCCESS : NOT_FOUND;
}

int nvmlDeviceGetGpuInstanceId(void *handle, unsigned *id) {
    World w;
    int error = begin("mig", &w);
    *id = gpu_of(handle, &w)->id;
    return error ? error : place_of(handle) < 0 ? NOT_SUPPORTED : SUCCESS;
}

int nvmlDeviceGetMemoryInfo(void *handle, Memory *memory) {
    World w;
    int error = begin("memory", &w);
    Gpu *gpu = gpu_of(handle, &w);
    if (gpu->mig) return NO_PERMISSION; /* of all its instances: to privileged callers */
    *memory = (Memory){gpu->total, gpu->total - gpu->used - gpu->reserved, gpu->used + gpu->reserved};
    return error;
}

int nvmlDeviceGetMemoryInfo_v2(void *handle, MemoryV2 *memory) {
    World w;
    int error = begin("memory_v2", &w);
    if (error) return error;
    if ((error = begin("memory", &w))) return error;
    if (memory->version != (sizeof(MemoryV2) | 2u << 24)) return VERSION_MISMATCH;
    Gpu *gpu = gpu_of(handle, &w);
    if (gpu->mig) return NO_PERMISSION;
    memory->total = gpu->total;
    memory->reserved = gpu->reserved;
    memory->used = gpu->used;
    memory->free = gpu->total - gpu->reserved - gpu->used;
    return SUCCESS;
}

static int sensor(void *handle, int which, unsigned *value) {
    World w;
    int error = begin("sensors", &w);
    Gpu *gpu = gpu_of(handle, &w);
    *value = gpu->sensors[which];
    return error ? error : gpu->told ? SUCCESS : NOT_SUPPORTED;
}

int nvmlDeviceGetUtilizationRates(void *handle, Utilization *rates) {
    rates->memory = 0;
    return sensor(handle, 0, &rates->gpu);
}

int nvmlDeviceGetTemperature(void *handle, unsigned sensor_type, unsigned *celsius) {
    return sensor_type ? NOT_SUPPORTED : sensor(handle, 1, celsius);
}

int nvmlDeviceGetPowerUsage(void *handle, unsigned *milliwatts) { return sensor(handle, 2, milliwatts); }

/* An instance lists what runs on any of its GPU, each with its instance, so that a reader has to look at that. */
static int list(void *handle, const char *call, int graphics, unsigned *count, ProcessInfo *infos) {
    World w;
    int error = begin(call, &w);
    if (error) return error;
    unsigned room = infos ? *count : 0, found = 0;
    for (int i = 0; i < w.n_processes; i++) {
        Process *p = &w.processes[i];
        if (p->gpu != index_of(handle) || p->graphics != graphics) continue;
        if (found < room) infos[found] = (ProcessInfo){p->pid, p->used, p->id, p->id == NO_INSTANCE ? p->id : 0};
        found++;
    }
    *count = found;
    return found > room ? INSUFFICIENT_SIZE : SUCCESS;
}

int nvmlDeviceGetComputeRunningProcesses_v3(void *handle, unsigned *count, ProcessInfo *infos) {
    return list(handle, "compute", 0, count, infos);
}

int nvmlDeviceGetGraphicsRunningProcesses_v3(void *handle, unsigned *count, ProcessInfo *infos) {
    return list(handle, "graphics", 1, count, infos);
}
