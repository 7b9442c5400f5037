/* A libnvidia-ml.so.1 for tests: what pynvml calls, answered from the control file $NVML_STUB, read again at every call.
 *
 *   gpu UUID TOTAL RESERVED USED [mig]                         one line a GPU, in the driver's order
 *   late GPU BYTES UNTIL                                       BYTES more are used until UNTIL (CLOCK_MONOTONIC, seconds)
 *   process GPU compute|graphics PID BYTES|na [UNTIL]          listed until then
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
#define NA 0xFFFFFFFFFFFFFFFFull
enum { SUCCESS = 0, INVALID_ARGUMENT = 2, NOT_SUPPORTED = 3, INSUFFICIENT_SIZE = 7, NOT_FOUND = 6, VERSION_MISMATCH = 25, UNKNOWN = 999 };

typedef unsigned long long u64;
typedef struct { char uuid[96]; u64 total, reserved, used; int mig; } Gpu;
typedef struct { int gpu, graphics; unsigned pid; u64 used; } Process;
typedef struct { Gpu gpus[GPUS]; int n_gpus; Process processes[PROCESSES]; int n_processes; int error, hangs; } World;

typedef struct { u64 total, free, used; } Memory;
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
        Process process = {0};
        u64 count;
        int index, code, after = 0;
        double until = 1e18;
        if (sscanf(line, "gpu %95s %llu %llu %llu", gpu.uuid, &gpu.total, &gpu.reserved, &gpu.used) == 4) {
            gpu.mig = strstr(line, " mig") != NULL;
            if (world->n_gpus < GPUS) world->gpus[world->n_gpus++] = gpu;
        } else if (sscanf(line, "late %d %llu %lf", &index, &count, &until) == 3) {
            if (until > now()) world->gpus[index].used += count;
        } else if (sscanf(line, "process %d %95s %u %31s %lf", &process.gpu, word, &process.pid, bytes, &until) >= 4) {
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

static int index_of(void *handle) { return (int)(long)handle - 1; }

int nvmlInitWithFlags(unsigned flags) { World w; (void)flags; return begin("init", &w); }
int nvmlShutdown(void) { return SUCCESS; }

const char *nvmlErrorString(int code) {
    switch (code) {
        case 3: return "Not Supported";
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
    *handle = (void *)(long)(index + 1);
    return error ? error : (int)index < w.n_gpus ? SUCCESS : INVALID_ARGUMENT;
}

int nvmlDeviceGetUUID(void *handle, char *text, unsigned size) {
    World w;
    int error = begin("uuid", &w);
    snprintf(text, size, "%s", w.gpus[index_of(handle)].uuid);
    return error;
}

int nvmlDeviceGetName(void *handle, char *text, unsigned size) { (void)handle; snprintf(text, size, "NVIDIA Stub"); return SUCCESS; }
int nvmlDeviceGetIndex(void *handle, unsigned *index) { *index = index_of(handle); return SUCCESS; }

int nvmlDeviceGetMigMode(void *handle, unsigned *current, unsigned *pending) {
    World w;
    int error = begin("mig", &w);
    *current = *pending = w.gpus[index_of(handle)].mig;
    return error;
}

int nvmlDeviceGetMemoryInfo(void *handle, Memory *memory) {
    World w;
    int error = begin("memory", &w);
    Gpu *gpu = &w.gpus[index_of(handle)];
    *memory = (Memory){gpu->total, gpu->total - gpu->used - gpu->reserved, gpu->used + gpu->reserved};
    return error;
}

int nvmlDeviceGetMemoryInfo_v2(void *handle, MemoryV2 *memory) {
    World w;
    int error = begin("memory_v2", &w);
    if (error) return error;
    if ((error = begin("memory", &w))) return error;
    if (memory->version != (sizeof(MemoryV2) | 2u << 24)) return VERSION_MISMATCH;
    Gpu *gpu = &w.gpus[index_of(handle)];
    memory->total = gpu->total;
    memory->reserved = gpu->reserved;
    memory->used = gpu->used;
    memory->free = gpu->total - gpu->reserved - gpu->used;
    return SUCCESS;
}

static int list(void *handle, const char *call, int graphics, unsigned *count, ProcessInfo *infos) {
    World w;
    int error = begin(call, &w);
    if (error) return error;
    unsigned room = infos ? *count : 0, found = 0;
    for (int i = 0; i < w.n_processes; i++) {
        Process *p = &w.processes[i];
        if (p->gpu != index_of(handle) || p->graphics != graphics) continue;
        if (found < room) infos[found] = (ProcessInfo){p->pid, p->used, 0xFFFFFFFFu, 0xFFFFFFFFu};
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
